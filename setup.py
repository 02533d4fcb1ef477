# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Build of the koopman_ros package, for colcon (ament_python) and for pip alike."""

from glob import glob
import os
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = 'koopman_ros'
MANIFEST = ElementTree.parse(os.path.join(os.path.dirname(os.path.abspath(__file__)),
                                          'package.xml')).getroot()
TRAIN = ['torch==2.13.0', 'cloudpickle', 'joblib', 'tqdm']


def _data_files() -> list[tuple[str, list[str]]]:
    """List what goes under share/: the ament marker, the manifest, the configuration."""
    share = os.path.join('share', PACKAGE)
    return [
        (os.path.join('share', 'ament_index', 'resource_index', 'packages'),
         [os.path.join('resource', PACKAGE)]),
        (share, ['package.xml']),
        (os.path.join(share, 'config'),
         sorted(glob('config/*.yaml') + glob('config/*.xml') + glob('config/*.json'))),
        (os.path.join(share, 'config', 'models'), sorted(glob('config/models/*'))),
        (os.path.join(share, 'config', 'plants'), sorted(glob('config/plants/*'))),
        (os.path.join(share, 'launch'), sorted(glob('examples/*.launch.py'))),
    ]


setup(
    name=PACKAGE,
    version=MANIFEST.findtext('version'),
    description='Control of nonlinear plants by learned linear representations, on ROS 2',
    maintainer=MANIFEST.findtext('maintainer'),
    maintainer_email=MANIFEST.find('maintainer').get('email'),
    project_urls={url.get('type'): url.text for url in MANIFEST.findall('url')},
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, PACKAGE + '.*']),
    package_data={PACKAGE: ['py.typed', 'export/templates/*', 'panel/*.css', 'panel/*.html',
                           'panel/*.js']},
    data_files=_data_files(),
    python_requires='>=3.11',
    zip_safe=True,
    install_requires=['setuptools', 'numpy', 'scipy', 'PyYAML', 'pint', 'mcap>=1.5',
                      'lz4', 'zstandard', 'rosbags', 'safetensors'],
    extras_require={
        # A sourced ROS 2 installation brings these itself; elsewhere PyPI does.
        'ros': [
            'ros-jazzy-rclpy==7.1.6',
            'ros-jazzy-common-interfaces==5.3.6',
            'ros-jazzy-rmw-fastrtps-cpp==8.4.3',
        ],
        'demo': ['matplotlib'],
        # the operator's panel, with all that its pages load
        'panel': ['nicegui>=3', 'argon2-cffi', 'itsdangerous', 'limits'],
        # the predictive law: solver of quadratic programs
        'mpc': ['daqp'],
        'train': TRAIN,
        # learning from tables, without ROS
        'learn': [*TRAIN, 'matplotlib', 'pandas', 'pyarrow'],
        # training on the workers of a Dask scheduler
        'cluster': ['distributed'],
        # what studies and benchmarks compare with
        'bench': ['casadi==3.8.2', 'control', 'daqp', 'do-mpc==5.1.2', 'nfoursid',
                  'pykoop'],
        'docs': ['furo', 'myst-parser', 'sphinx'],
        'test': [
            'argon2-cffi',
            'colcon-common-extensions',
            'control',
            'daqp',
            'distributed',
            'hypothesis',
            'itsdangerous',
            'limits',
            'mypy',
            'nicegui>=3',
            'packaging',
            'playwright',
            'pytest>=7.4',
            'pytest-timeout',
            'pytest-xdist',
            'rosbags',
            'ruff',
            'safetensors',
            'setuptools<80',
            'threadpoolctl',
        ],
    },
    entry_points={
        'console_scripts': [
            'plant = koopman_ros.process_entry:plant',
            'controller = koopman_ros.process_entry:controller',
            'trainer = koopman_ros.process_entry:trainer',
            'player = koopman_ros.process_entry:player',
            'replay = koopman_ros.process_entry:replay',
            'panel = koopman_ros.process_entry:panel',
            'learn = koopman_ros.process_entry:learn',
            'export_c = koopman_ros.process_entry:export_c',
            'koopman_ros = koopman_ros.process_entry:command_line',
        ],
    },
)
