# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Build of the oven's package: one module, one parameter file, one entry point."""

from setuptools import setup

setup(
    name='oven',
    version='0.1.0',
    py_modules=['oven'],
    data_files=[('share/ament_index/resource_index/packages', ['resource/oven']),
                ('share/oven', ['package.xml', 'oven.yaml', 'existing.yaml'])],
    entry_points={'koopman_ros.plants': ['oven = oven:Oven']},
)
