# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the run-time packages import, checked in a process that has nothing loaded."""

from support.distributions import loaded


def test_runtime_needs_neither_ros_nor_torch() -> None:
    loaded('koopman_ros.model, koopman_ros.control, koopman_ros.plants, koopman_ros.records',
           ('rclpy', 'torch', 'matplotlib', 'daqp'))


def test_the_model_loads_no_other_package_of_ours_but_core() -> None:
    ours = {name.split('.')[1] for name in loaded('koopman_ros.model')
            if name.startswith('koopman_ros.')}
    assert ours == {'core', 'model', 'model_classes'}


def test_nodes_load_nothing_large_that_they_do_not_need() -> None:
    assert not loaded('koopman_ros.nodes.controller, koopman_ros.nodes.trainer') & {
        'torch', 'matplotlib', 'pint', 'daqp', 'nicegui', 'scipy.integrate', 'scipy.optimize',
        'koopman_ros.plants', 'koopman_ros.learning'}
