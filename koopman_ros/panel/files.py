# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Text and files, bounded when they are read."""

import os
from pathlib import Path
import stat


def sanitize_text(text: str, longest: int) -> str:
    """Return a text on one line of printable characters, cut to a length."""
    # a huge text is cut first, with room for the blanks that go
    line = ' '.join(text[:4 * longest].split())
    if not line.isprintable():
        line = ''.join(one if one.isprintable() else '�' for one in line)
    return line if len(line) <= longest else line[:longest - 1] + '…'


def read_bounded(path: Path, most: int) -> tuple[bytes, os.stat_result]:
    """
    Return the content of a regular file and its status.

    :param most: bytes.
    :raises ValueError: for another kind of file, or a larger one.
    :raises OSError: for a file that cannot be opened or read.
    """
    # opening is a command to some devices, and waits at a pipe
    _check_regular(os.stat(path), path)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    with open(descriptor, 'rb') as file:
        about = os.fstat(descriptor)
        _check_regular(about, path)
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f'{path} has more than {most} bytes')
    return content, about


def _check_regular(about: os.stat_result, path: Path) -> None:
    if not stat.S_ISREG(about.st_mode):
        raise ValueError(f'{path} is not a regular file')
