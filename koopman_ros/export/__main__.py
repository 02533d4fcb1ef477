# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""``python -m koopman_ros.export``: the program :mod:`koopman_ros.export.command_line`."""

import sys

from koopman_ros.process_entry import export_c

if __name__ == '__main__':
    sys.exit(export_c())
