# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
A whole loop from one parameter file: plant, controller and trainer.

``ros2 launch koopman_ros loop.launch.py system:=two_tanks`` takes that of a plant that is shipped,
``parameters:=loop.yaml`` that of a file. Each node configures and activates itself; with
``autostart:=false`` it waits for a lifecycle manager. Without the file no node starts.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Describe the three nodes."""
    shipped = [FindPackageShare('koopman_ros'), '/config/plants/', LaunchConfiguration('system'),
               '.yaml']
    autostart = ParameterValue(LaunchConfiguration('autostart'), value_type=bool)
    # not in `parameters`: launch_ros leaves out a missing file, and the reactor would start
    file = ['--params-file', LaunchConfiguration('parameters')]
    return LaunchDescription([
        DeclareLaunchArgument('system', default_value='reactor',
                              description='plant that is shipped'),
        DeclareLaunchArgument('parameters', default_value=shipped,
                              description='parameter file of the whole loop'),
        DeclareLaunchArgument('autostart', default_value='true',
                              description='false leaves the start to a lifecycle manager'),
        *(Node(package='koopman_ros', executable=name, name=name, output='screen',
               ros_arguments=file, parameters=[{'autostart': autostart}])
          for name in ('plant', 'controller', 'trainer')),
    ])
