# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""``python -m koopman_ros learn``: the programs without ROS, where they are not on the path."""

import sys

from koopman_ros import process_entry

PROGRAMS = ('learn', 'export_c')


def main() -> int:
    """Run the program that the first argument names."""
    name = sys.argv[1] if len(sys.argv) > 1 else ''
    if name not in PROGRAMS:
        print(f'usage: python -m koopman_ros {" | ".join(PROGRAMS)} ...', file=sys.stderr)
        return 1
    del sys.argv[1]
    code: int = getattr(process_entry, name)()
    return code


if __name__ == '__main__':
    sys.exit(main())
