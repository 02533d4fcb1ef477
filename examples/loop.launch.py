# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
A whole loop from one parameter file: plant, controller and trainer.

``ros2 launch koopman_ros loop.launch.py system:=two_tanks`` takes that of a plant that is shipped,
``parameters:=loop.yaml`` that of a file, and ``namespace:=line_1`` starts it in a namespace. Each
node configures and activates itself; with ``autostart:=false`` it waits for a lifecycle manager.
Without the file no node starts.
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
    autostart, use_sim_time = (ParameterValue(LaunchConfiguration(name), value_type=bool)
                               for name in ('autostart', 'use_sim_time'))
    # the file is not in `parameters`: launch_ros leaves out a missing one, and the reactor would
    # start
    arguments = ['--params-file', LaunchConfiguration('parameters'),
                 '--log-level', LaunchConfiguration('log_level')]
    return LaunchDescription([
        DeclareLaunchArgument('system', default_value='reactor',
                              description='plant that is shipped'),
        DeclareLaunchArgument('parameters', default_value=shipped,
                              description='parameter file of the whole loop'),
        DeclareLaunchArgument('autostart', default_value='true',
                              description='false leaves the start to a lifecycle manager'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the nodes'),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='true: controller and trainer follow /clock'),
        DeclareLaunchArgument('log_level', default_value='info', description='e.g. debug'),
        DeclareLaunchArgument('respawn', default_value='false',
                              description='true starts a node that has ended again'),
        *(Node(package='koopman_ros', executable=name, name=name, output='screen',
               namespace=LaunchConfiguration('namespace'), ros_arguments=arguments,
               respawn=LaunchConfiguration('respawn'), respawn_delay=1.0,
               # the plant publishes /clock
               parameters=[{'autostart': autostart, **(
                   {} if name == 'plant' else {'use_sim_time': use_sim_time})}])
          for name in ('plant', 'controller', 'trainer')),
    ])
