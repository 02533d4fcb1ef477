# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The demo of retraining; see :mod:`koopman_ros.demo.retraining_demo`."""

import sys

from koopman_ros.process_entry import run_program

if __name__ == '__main__':
    sys.exit(run_program('koopman_ros.demo.retraining_demo', 130))
