# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
ROS processes for tests and demos: a harness that starts, waits for and ends them.

Every process ends with the test: when it passes, when it fails, when it is killed, and when the
middleware hangs. See :class:`Harness`, which needs no launch file.
"""

from koopman_ros.testing.harness import Harness, HarnessError
from koopman_ros.testing.process import (
           deferred_interrupt,
           isolated_domain,
           NodeProcess,
           reserved_output,
)

__all__ = ['Harness', 'HarnessError', 'NodeProcess', 'deferred_interrupt', 'isolated_domain',
           'reserved_output']
