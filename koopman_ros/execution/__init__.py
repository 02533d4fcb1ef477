# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Execution of long work: serial, in processes or on a Dask cluster; without ROS and torch."""

from koopman_ros.execution.backends import (
    Backend,
    backend_of,
    executor_rejection,
    Notify,
    SchedulerLost,
    Serial,
    Watch,
    WorkerLost,
)

__all__ = ['Backend', 'Notify', 'SchedulerLost', 'Serial', 'Watch', 'WorkerLost', 'backend_of',
           'executor_rejection']
