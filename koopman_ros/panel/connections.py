# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Bounds of the connections of the web server, and of the lines of its log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import contextlib
import logging
import resource
import socket
from typing import Any

from limits import parse
from limits.storage import MemoryStorage
from limits.strategies import FixedWindowRateLimiter

MAX_CONNECTIONS = 256
BACKLOG = 64  # connections that are accepted at once
_WAITING = 1024  # connections that the kernel holds until they are accepted
_SHARE_OF_FILES = 4  # one part of the open files is for connections

Peer = tuple[str, int]


class Listener(socket.socket):
    """
    A listening socket with a bound on the connections that are open at a time.

    A new connection past the bound closes the oldest without a request that is served:
    connections that never finish their request keep none out. The bound holds from the first
    packet, also before TLS has been negotiated.

    :ivar most: bound of the open connections; lower if the process may open few files.
    """

    def __init__(self, *args: Any, most: int = MAX_CONNECTIONS) -> None:
        super().__init__(*args)
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self.most = min(most, max(files // _SHARE_OF_FILES, 1)) if files > 0 else most
        self._open: dict[Peer, socket.socket] = {}
        self._served: Counter[Peer] = Counter()

    def listen(self, backlog: int = BACKLOG) -> None:
        """Listen; the kernel holds more connections than are accepted at once."""
        super().listen(max(backlog, _WAITING))

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; raise ConnectionAbortedError if all others are served."""
        connection, address = super().accept()
        self._open = {peer: one for peer, one in self._open.items() if one.fileno() >= 0}
        if len(self._open) >= self.most and not self._close_one():
            connection.close()
            raise ConnectionAbortedError('all connections are in use')
        self._open[address[0], address[1]] = connection
        return connection, address

    @contextlib.contextmanager
    def serving(self, peer: Any) -> Iterator[None]:
        """Keep the connection of a peer open while its request is served."""
        place = tuple(peer or ())
        self._served[place] += 1
        try:
            yield
        finally:
            self._served[place] -= 1
            if not self._served[place]:
                del self._served[place]

    def _close_one(self) -> bool:
        oldest = next((peer for peer in self._open if peer not in self._served), None)
        if oldest is None:
            return False
        with contextlib.suppress(OSError):
            # the event loop notices the end, and closes the connection
            self._open.pop(oldest).shutdown(socket.SHUT_RDWR)
        return True


class RateLimiter(logging.Filter):
    """Passes twenty records of some loggers a minute, and drops the rest."""

    def __init__(self) -> None:
        super().__init__()
        self._rate, self._limiter = parse('20/minute'), FixedWindowRateLimiter(MemoryStorage())

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is written; the last one mentions that others are dropped."""
        passes = self._limiter.hit(self._rate)
        if passes and not self._limiter.test(self._rate):
            record.msg, record.args = (
                f'{record.getMessage()} (further lines are dropped for up to a minute)'), ()
        return passes
