# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Compile ahead of the first controller: ``python -m koopman_ros.compiled``."""

import sys
import time

from koopman_ros.kernels import COMPILED, named, PACKAGE


def main() -> int:
    """Compile what is not kept yet; return the exit code, 1 where nothing compiles."""
    begun = time.monotonic()
    if named(COMPILED) is None:
        print(f'{PACKAGE} is not installed: pip install {PACKAGE}', file=sys.stderr)
        return 1
    from koopman_ros.compiled.jit import FOLDER

    print(f'compiled code is in {FOLDER}, after {time.monotonic() - begun:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
