# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sessions of users who are logged in, and the limit of wrong log-ins."""

from collections.abc import Callable
from dataclasses import dataclass
import ipaddress
import secrets
import threading
import time

from limits import parse, RateLimitItem
from limits.storage import MemoryStorage
from limits.strategies import FixedWindowRateLimiter

from koopman_ros.panel.access import normalised
from koopman_ros.panel.requests import Role

MAX_SESSIONS_OF_A_USER = 20
_MAX_KNOWN = 10_000  # names with the addresses from which they logged in


class Throttle:
    """
    Limit of wrong log-ins of each name from each address, and of each address with any names.

    Attempts from one address never delay another address. A user who has logged in from an address
    is not delayed by attempts with other names from there. An IPv6 address counts as its network
    of 64 bits. Several threads may use it.
    """

    #: wrong log-ins with one name from one address
    NAME = (parse('5/minute'), parse('20/hour'))
    #: wrong log-ins with any names from one address
    ADDRESS = (parse('20/minute'), parse('100/hour'))

    def __init__(self) -> None:
        self._storage = MemoryStorage()
        self._limiter = FixedWindowRateLimiter(self._storage)
        self._known: set[tuple[str, str]] = set()
        self._lock = threading.Lock()

    def attempt(self, address: str, name: str) -> float:
        """
        Return 0 if a log-in may be tried, or the seconds until then.

        The attempt counts as wrong until :meth:`succeeded` is called: no further one passes while
        passwords are verified.
        """
        with self._lock:
            limits = self._limits(address, name)
            waits = [self._limiter.get_window_stats(item, *key).reset_time - time.time()
                     for item, key in limits if not self._limiter.test(item, *key)]
            if waits:
                return max(*waits, 1.0)
            for item, key in limits:
                self._limiter.hit(item, *key)
        return 0.0

    def succeeded(self, address: str, name: str) -> None:
        """Take back the attempt, and free the name at this address."""
        pair = _network(address), _short(name)
        with self._lock:
            for item, key in self._limits(address, name):
                if item in self.NAME:
                    self._limiter.clear(item, *key)
                else:
                    # earlier attempts from there with other names were wrong
                    self._storage.decr(item.key_for(*key))
            if len(self._known) >= _MAX_KNOWN:
                self._known.clear()
            self._known.add(pair)

    def _limits(self, address: str, name: str) -> list[tuple[RateLimitItem, tuple[str, ...]]]:
        pair = _network(address), _short(name)
        of_address = () if pair in self._known else self.ADDRESS
        return [*((item, ('name', *pair)) for item in self.NAME),
                *((item, ('address', pair[0])) for item in of_address)]


@dataclass
class Session:
    """A user who is logged in."""

    name: str
    role: Role
    opened: float = 0.0  #: s of the sessions' clock
    used: float = 0.0


class Sessions:
    """
    Open sessions by the id in their signed cookie; several threads may use it.

    :param clock: monotonic time in s.
    :param longest: s from the log-in to the end.
    :param idle: s without use to the end.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *,
                 longest: float = 12 * 3600.0, idle: float = 3600.0) -> None:
        self._clock, self.longest, self.idle = clock, longest, idle
        self._open: dict[str, Session] = {}
        self._lock = threading.Lock()

    def open(self, name: str, role: Role) -> str:
        """Open a session and return its id; the oldest of too many of a user ends."""
        new, now = secrets.token_urlsafe(32), self._clock()
        with self._lock:
            self._open = {key: one for key, one in self._open.items() if not self._over(one)}
            own = [key for key, one in self._open.items() if one.name == name]
            if len(own) >= MAX_SESSIONS_OF_A_USER:
                del self._open[own[0]]
            self._open[new] = Session(name, role, now, now)
        return new

    def find(self, key: object, *, use: bool = True) -> Session | None:
        """
        Return an open session.

        :param use: whether the user did something; False for a page that is only open.
        """
        with self._lock:
            found = self._open.get(key) if isinstance(key, str) else None
            if found is None or self._over(found):
                return None
            if use:
                found.used = self._clock()
            return found

    def close(self, key: object) -> None:
        """End a session."""
        with self._lock:
            if isinstance(key, str):
                self._open.pop(key, None)

    def _over(self, session: Session) -> bool:
        now = self._clock()
        return now - session.opened >= self.longest or now - session.used >= self.idle


def _short(name: str) -> str:
    return normalised(name[:256])


def _network(address: str) -> str:
    """Return an IPv4 address, or the network of an IPv6 address."""
    try:
        found = ipaddress.ip_address(address[:64])
    except ValueError:
        return address[:64]
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    if found.ipv4_mapped:
        return str(found.ipv4_mapped)
    return str(ipaddress.IPv6Network((int(found), 64), strict=False))
