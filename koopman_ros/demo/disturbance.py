# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The demo of a measured disturbance; see :mod:`koopman_ros.demo.disturbance_demo`."""

import sys

from koopman_ros.process_entry import run_program

if __name__ == '__main__':
    sys.exit(run_program('koopman_ros.demo.disturbance_demo', 130))
