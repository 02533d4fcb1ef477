# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""``python -m koopman_ros learn``: the program :mod:`koopman_ros.learn_files`."""

import sys

from koopman_ros import process_entry


def main() -> int:
    """Run the program, which the first argument names."""
    if sys.argv[1:2] != ['learn']:
        print('usage: python -m koopman_ros learn ...', file=sys.stderr)
        return 1
    del sys.argv[1]
    return process_entry.learn()


if __name__ == '__main__':
    sys.exit(main())
