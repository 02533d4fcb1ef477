# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reading of regular files up to a limit; devices, pipes and sockets are refused."""

import os
import stat

_KINDS = ((stat.S_ISDIR, 'a folder'), (stat.S_ISFIFO, 'a named pipe'), (stat.S_ISSOCK, 'a socket'),
          (stat.S_ISCHR, 'a device'), (stat.S_ISBLK, 'a device'))


class NotRegularError(OSError):
    """The path is no regular file; the message says what it is."""


def read_regular(path: str | os.PathLike[str], limit: int) -> bytes:
    """
    Return what a regular file holds, or its first `limit` + 1 bytes.

    :param path: the file, or a link to it.
    :param limit: how many bytes are wanted at most.
    :raises NotRegularError: for a device, a pipe, a socket or a folder.
    :raises OSError: when it cannot be opened or read.
    """
    # looked at before it is opened, for opening is an order to some devices
    _refuse_special(os.stat(path))
    # a pipe that took its place would keep the opener waiting, and a terminal take it over
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    with open(descriptor, 'rb', buffering=0) as file:
        _refuse_special(os.fstat(descriptor))
        content = bytearray()
        while len(content) <= limit and (part := file.read(limit + 1 - len(content))):
            content += part
    return bytes(content)


def _refuse_special(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = next((word for test, word in _KINDS if test(found.st_mode)), 'something else')
        raise NotRegularError(f'it is {kind}, not a regular file')
