# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""``python -m koopman_ros.learning``: the program :mod:`koopman_ros.learn`."""

import sys

from koopman_ros.process_entry import learn

if __name__ == '__main__':
    sys.exit(learn())
