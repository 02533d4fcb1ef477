# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The demos: of a set-point, or by the first argument ``retrain`` or ``disturbance``."""

import sys

from koopman_ros.process_entry import run_program

_DEMOS = {'retrain': 'retraining_demo', 'disturbance': 'disturbance_demo'}

if __name__ == '__main__':
    other = sys.argv.pop(1) if set(sys.argv[1:2]) & set(_DEMOS) else ''
    sys.exit(run_program(f'koopman_ros.demo.{_DEMOS.get(other, "setpoint_demo")}', 130))
