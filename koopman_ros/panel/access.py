# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Who may do what in the panel: users and their passwords, log-ins, sessions, origins.

``python -m koopman_ros.panel.access FILE NAME ROLE`` asks for a password and writes its line.
"""

import argparse
import base64
import binascii
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
import contextlib
from dataclasses import dataclass, field
from enum import Enum
import getpass
import hashlib
import hmac
import ipaddress
import math
import os
from pathlib import Path
import re
import secrets
import stat
import sys
import tempfile
import threading
import time
import unicodedata

MAX_FILE = 256 * 1024  # bytes
MAX_USERS = 1000
MIN_PASSWORD = 8  # characters
MAX_PASSWORD = 1024
MAX_SESSIONS = 1000
MAX_SESSIONS_OF_A_USER = 20

_NAME = re.compile(r'[\w.@-]{1,64}')
_ORIGIN = re.compile(r'(https?)://([^/?#]+)', re.ASCII)
_HOST = re.compile(r'(\[[0-9a-f:.]+\]|[\w.-]+)(?::(\d{1,5}))?', re.ASCII)
_PORTS = {'http': 80, 'https': 443}
_MAX_MEMORY = 256 * 1024 * 1024  # bytes that a line of the file may make scrypt take
_MAX_HEADER = 512  # characters
_MAX_KEYS = 10_000  # addresses, and names from them, that a throttle remembers
_NAMES = 4  # times as many wrong log-ins with any names as with one


class Role(Enum):
    """What a user may do; the value is the word in the file."""

    VIEWER = 'viewer'  #: look
    OPERATOR = 'operator'  #: look and act


@dataclass(frozen=True)
class Cost:
    """Of scrypt (RFC 7914): 128 n r bytes of memory, gone through p times."""

    n: int
    r: int
    p: int

    def __post_init__(self) -> None:
        if self.n < 2 or self.n & (self.n - 1) or self.r < 1 or not 1 <= self.p <= 16:
            raise ValueError(f'no cost of scrypt: n = {self.n} must be a power of 2, r = {self.r} '
                             f'at least 1, p = {self.p} from 1 to 16')
        if 128 * self.n * self.r > _MAX_MEMORY or self.n >= 2**(16 * min(self.r, 64)):
            raise ValueError(f'n = {self.n} and r = {self.r} of scrypt take more than '
                             f'{_MAX_MEMORY // 2**20} MiB, or n is not below 2^(16 r)')

    def digest(self, password: str, salt: bytes, length: int) -> bytes:
        """Hash a password; browsers and terminals may write its characters differently."""
        return hashlib.scrypt(_normal(password).encode(errors='surrogatepass'), salt=salt,
                              n=self.n, r=self.r, p=self.p, dklen=length,
                              maxmem=2 * _MAX_MEMORY)


#: One that OWASP's cheat sheet on the storage of passwords names; of these, one of little memory.
COST = Cost(2**14, 8, 5)


@dataclass(frozen=True)
class _Secret:
    """What the file holds of a password."""

    cost: Cost
    salt: bytes = field(repr=False)
    digest: bytes = field(repr=False)

    @classmethod
    def of(cls, password: str, cost: Cost) -> '_Secret':
        salt = secrets.token_bytes(16)
        return cls(cost, salt, cost.digest(password, salt, 32))

    @classmethod
    def parse(cls, text: str) -> '_Secret':
        method, *numbers = text.split('$')
        if method != 'scrypt' or len(numbers) != 5:
            raise ValueError('the password must be scrypt$n$r$p$salt$hash')
        *numbers, salt, digest = numbers
        if not all(re.fullmatch('[0-9]{1,9}', number) for number in numbers):
            raise ValueError('n, r and p of scrypt must be numbers')
        try:
            secret = cls(Cost(*map(int, numbers)), base64.b64decode(salt, validate=True),
                         base64.b64decode(digest, validate=True))
        except binascii.Error as error:
            raise ValueError(f'salt and hash must be base64: {error}') from error
        if not (8 <= len(secret.salt) <= 64 and 16 <= len(secret.digest) <= 64):
            raise ValueError('the salt must have 8 to 64 bytes and the hash 16 to 64')
        return secret

    def fits(self, password: str) -> bool:
        return hmac.compare_digest(
            self.cost.digest(password, self.salt, len(self.digest)), self.digest)

    def __str__(self) -> str:
        salt, digest = (base64.b64encode(part).decode() for part in (self.salt, self.digest))
        return f'scrypt${self.cost.n}${self.cost.r}${self.cost.p}${salt}${digest}'


def hashed(password: str, cost: Cost = COST) -> str:
    """
    Return what the file of users holds of a password: ``scrypt$n$r$p$salt$hash``.

    :raises ValueError: for one that is too short or too long.
    """
    if not MIN_PASSWORD <= len(_normal(password)) <= MAX_PASSWORD or '\0' in password:
        raise ValueError(f'a password must have {MIN_PASSWORD} to {MAX_PASSWORD} characters, '
                         'none of them NUL')
    return str(_Secret.of(password, cost))


@dataclass(frozen=True)
class _User:
    role: Role
    secret: _Secret


class Users:
    """The users of a panel; several threads may use it."""

    def __init__(self, users: Mapping[str, _User]) -> None:
        self._users = dict(users)
        costs = [user.secret.cost for user in self._users.values()]
        dearest = max(costs, key=lambda cost: cost.n * cost.r * cost.p, default=COST)
        # for names that there are not; no password is known to fit
        self._decoy = _Secret(dearest, secrets.token_bytes(16), secrets.token_bytes(32))
        # log-ins take one core and the memory of one, however many come
        self._turn = threading.Lock()

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> 'Users':
        """
        Read a file with a line ``name:role:scrypt$n$r$p$salt$hash`` for each user.

        Empty lines and those with # at their beginning are skipped.

        :raises ValueError: naming the line, or why the file is not to be trusted.
        :raises OSError: when it cannot be opened or read.
        """
        return cls(_parsed(_read(path), path))

    def verify(self, name: str, password: str) -> Role | None:
        """
        Return the role of a user whose password this is.

        A name that there is not takes as long as one that there is, of those with the same cost.
        """
        # to scrypt, zeros at the end are none
        if len(password) > MAX_PASSWORD or '\0' in password:
            return None
        user = self._users.get(_normal(name)) if len(name) <= MAX_PASSWORD else None
        with self._turn:
            fits = (user.secret if user else self._decoy).fits(password)
        return user.role if user and fits else None

    def __len__(self) -> int:
        return len(self._users)


@dataclass
class _Attempts:
    """Of one address or name."""

    recent: list[float] = field(default_factory=list)
    level: int = 0  # how often it had to wait
    until: float = -math.inf


class Throttle:
    """
    A limit to wrong log-ins, of each name from each address, and from each address with any names.

    After some in a short time the next must wait, and twice as long after each that is wrong
    again, until none came for the longest of these times. Attempts from one address never make
    another address wait. A user who logged in from an address before is not kept out by attempts
    with other names from there. IPv6 counts by network of 64 bits. Several threads may use it.

    :param clock: s, rising.
    :param wrong: log-ins that may be wrong in the time `within`, of one name from one address;
        with any names it is four times as many.
    :param within: s.
    :param first: s of the first wait.
    :param longest: s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *, wrong: int = 5,
                 within: float = 60.0, first: float = 10.0, longest: float = 300.0) -> None:
        self._clock, self._wrong, self._within = clock, wrong, within
        self._first, self._longest = first, longest
        self._attempts: OrderedDict[tuple[str, ...], _Attempts] = OrderedDict()
        self._known: OrderedDict[tuple[str, str], None] = OrderedDict()
        self._lock = threading.Lock()

    def attempt(self, address: str, name: str) -> float:
        """
        Return 0 where a log-in may be tried, or how many s it must wait.

        It counts as wrong until :meth:`succeeded` takes that back, so that none gets through while
        others are being checked.
        """
        now = self._clock()
        with self._lock:
            found = [self._attempts_of(key, now) for key in self._keys(address, name)]
            wait = max(attempts.until for attempts in found) - now
            if wait > 0.0:
                return wait
            for key, attempts in zip(self._keys(address, name), found, strict=True):
                attempts.recent = [*(at for at in attempts.recent if now - at < self._within), now]
                most = self._wrong * (_NAMES if key[0] == 'address' else 1)
                if attempts.level or len(attempts.recent) >= most:
                    pause = self._first * 2.0 ** min(attempts.level, 60)
                    attempts.level, attempts.until = (
                        attempts.level + 1, now + min(pause, self._longest))
        return 0.0

    def succeeded(self, address: str, name: str) -> None:
        """Take note that the password was right: it does not count, and the name is free there."""
        now = self._clock()
        with self._lock:
            for key in self._keys(address, name):
                if key[0] == 'name and address':
                    self._attempts.pop(key, None)
                elif key in self._attempts:
                    # what else came from there was wrong nevertheless
                    attempts = self._attempts[key]
                    del attempts.recent[-1:]
                    attempts.level = max(attempts.level - 1, 0)
                    attempts.until = min(attempts.until, now)
            pair = (_network(address), _brief(name))
            self._known[pair] = None
            self._known.move_to_end(pair)
            if len(self._known) > _MAX_KEYS:
                self._known.popitem(last=False)

    def _keys(self, address: str, name: str) -> list[tuple[str, ...]]:
        pair = (_network(address), _brief(name))
        keys: list[tuple[str, ...]] = [('name and address', *pair)]
        return keys if pair in self._known else [*keys, ('address', pair[0])]

    def _attempts_of(self, key: tuple[str, ...], now: float) -> _Attempts:
        attempts = self._attempts.setdefault(key, _Attempts())
        self._attempts.move_to_end(key)
        if len(self._attempts) > _MAX_KEYS:
            self._attempts.popitem(last=False)
        if attempts.level and now - attempts.until > self._longest:
            attempts.level = 0
        return attempts


@dataclass(frozen=True)
class Session:
    """A user who has logged in."""

    name: str
    role: Role


@dataclass
class _Held:
    session: Session
    opened: float
    used: float


class Sessions:
    """
    Sessions by random tokens, of which only hashes are held; several threads may use it.

    :param clock: s, rising.
    :param longest: s from the log-in to the end.
    :param idle: s without use to the end.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *,
                 longest: float = 12 * 3600.0, idle: float = 3600.0) -> None:
        self._clock, self._longest, self._idle = clock, longest, idle
        # what was used last is last
        self._held: OrderedDict[bytes, _Held] = OrderedDict()
        self._lock = threading.Lock()

    def open(self, name: str, role: Role) -> str:
        """Open a session and return its token; past the bounds the one idle for longest ends."""
        token, now = secrets.token_urlsafe(32), self._clock()
        with self._lock:
            for key in [key for key, held in self._held.items() if self._over(held, now)]:
                del self._held[key]
            own = [key for key, held in self._held.items() if held.session.name == name]
            if len(own) >= MAX_SESSIONS_OF_A_USER:
                del self._held[own[0]]
            elif len(self._held) >= MAX_SESSIONS:
                self._held.popitem(last=False)
            self._held[_fingerprint(token)] = _Held(Session(name, role), now, now)
        return token

    def find(self, token: str | None, *, use: bool = True) -> Session | None:
        """
        Return the session of a token that is valid.

        :param use: whether this is a sign of its user, rather than of a page that is only open.
        """
        if not token or len(token) > _MAX_HEADER:
            return None
        key, now = _fingerprint(token), self._clock()
        with self._lock:
            held = self._held.get(key)
            if held is None:
                return None
            if self._over(held, now):
                del self._held[key]
                return None
            if use:
                held.used = now
                self._held.move_to_end(key)
            return held.session

    def close(self, token: str | None) -> None:
        """End a session, where there is one."""
        if token and len(token) <= _MAX_HEADER:
            with self._lock:
                self._held.pop(_fingerprint(token), None)

    def close_all(self, name: str) -> None:
        """End all sessions of a user."""
        with self._lock:
            for key in [key for key, held in self._held.items() if held.session.name == name]:
                del self._held[key]

    def __len__(self) -> int:
        return len(self._held)

    def _over(self, held: _Held, now: float) -> bool:
        return now - held.opened >= self._longest or now - held.used >= self._idle


def same_origin(origin: str | None, host: str, scheme: str = 'http') -> bool:
    """
    Return whether a page of the panel itself opens this connection.

    Browsers send an origin with each WebSocket, so that none is refused as well.

    :param origin: header Origin.
    :param host: header Host.
    :param scheme: 'http', or 'https' where the panel is served by TLS.
    """
    if origin is None or len(origin) > _MAX_HEADER or not origin.isascii():
        return False
    match = _ORIGIN.fullmatch(origin.lower())
    if match is None or match[1] != scheme:
        return False
    place = _place(match[2], scheme)
    return place is not None and place == _place(host, scheme)


def is_loopback(host: str) -> bool:
    """Return whether an address, or the name localhost, is reached from this machine alone."""
    if host.lower() == 'localhost':
        return True
    try:
        address = ipaddress.ip_address(host[1:-1] if host[:1] + host[-1:] == '[]' else host)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def may_be_addressed(host: str, users: Users | None) -> bool:
    """
    Return whether a request may name this host.

    A panel without passwords is served on the loopback alone, yet a page from elsewhere could
    reach it by a name of its own that is made to lead here: host and origin then agree.

    :param host: header Host.
    """
    place = _place(host, 'http')
    return place is not None and (bool(users) or is_loopback(place[0]))


def needs_password(host: str, users: Users | None) -> str:
    """Return why a panel must not be served on an address without users; '' where it may."""
    if is_loopback(host) or users:
        return ''
    return (f'the panel is not served on {host!r} without passwords: name a file of users, '
            'written by python -m koopman_ros.panel.access FILE NAME ROLE, or serve it on '
            '127.0.0.1')


def main(args: Sequence[str] | None = None) -> int:
    """Ask for a password twice, and write the line of a user; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='python -m koopman_ros.panel.access',
        description="Add a user of the operator's panel, or give one another password or role.")
    parser.add_argument('file', type=Path, metavar='FILE', help='file of users; made if need be')
    parser.add_argument('name', metavar='NAME', help='letters, digits and . _ @ -')
    parser.add_argument('role', metavar='ROLE', choices=[role.value for role in Role],
                        help='viewer or operator')
    chosen = parser.parse_args(args)
    try:
        # before anybody is asked
        _check_name(_normal(chosen.name))
        if chosen.file.exists():
            Users.read(chosen.file)
        password = getpass.getpass(f'Password of {chosen.name}: ')
        if getpass.getpass('Once more: ') != password:
            raise ValueError('the two passwords differ: nothing was written')
        write_user(chosen.file, chosen.name, Role(chosen.role), hashed(password))
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    except (EOFError, KeyboardInterrupt):
        print('nothing was written', file=sys.stderr)
        return 1
    return 0


def write_user(path: str | os.PathLike[str], name: str, role: Role, secret: str) -> None:
    """
    Add or replace the line of a user, of a file that others then cannot read.

    The old file or the new one is there, never a part; other lines stay as they are.

    :param secret: of :func:`hashed`.
    :raises ValueError: for a name that cannot be one, or a file that :meth:`Users.read` refuses.
    :raises OSError: when it cannot be read or written.
    """
    # a link stays one
    target = Path(os.path.realpath(path))
    name = _normal(name)
    _check_name(name)
    lines, owner = [], None
    if target.exists():
        owner = target.stat()
        lines = _read(target).rstrip('\n').split('\n')
    line = f'{name}:{role.value}:{_Secret.parse(secret)}'
    # in its place, or last
    place = next((number for number, held in enumerate(lines)
                  if _normal(held.partition(':')[0].strip()) == name), len(lines))
    content = '\n'.join([*lines[:place], line, *lines[place + 1:]]).lstrip('\n') + '\n'
    _parsed(content, path)
    # of mode 0600
    descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=target.name, suffix='.tmp')
    try:
        with os.fdopen(descriptor, 'w', encoding='utf-8', newline='') as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            if owner is not None:
                # who serves the panel keeps the file that an administrator changes
                with contextlib.suppress(PermissionError):
                    os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
        os.replace(temporary, target)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise


def _read(path: str | os.PathLike[str]) -> str:
    """Return the text of a file of users that is to be trusted."""
    name = os.fspath(path)
    # before it is opened, which is an order to some devices; a pipe would keep us waiting
    _check_regular(os.stat(path), name)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    with open(descriptor, 'rb') as file:
        found = os.fstat(descriptor)
        _check_regular(found, name)
        if found.st_mode & 0o022:
            raise ValueError(f'{name} can be written by others, its mode is '
                             f'{stat.S_IMODE(found.st_mode):04o}: chmod 600 it, and check it')
        content = file.read(MAX_FILE + 1)
    if len(content) > MAX_FILE:
        raise ValueError(f'{name} has more than {MAX_FILE} bytes: it is no file of users')
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        line = content.count(b'\n', 0, error.start) + 1
        raise ValueError(f'{name}, line {line}: it is not UTF-8') from error


def _check_regular(found: os.stat_result, name: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f'{name} is not a regular file: name the file of users')


def _parsed(text: str, path: str | os.PathLike[str]) -> dict[str, _User]:
    users: dict[str, _User] = {}
    for number, line in enumerate(text.split('\n'), 1):
        if not line.strip() or line.startswith('#'):
            continue
        try:
            name, user = _user(line.strip())
            if name in users:
                raise ValueError(f'there is a user {name!r} already')
            if len(users) == MAX_USERS:
                raise ValueError(f'there are more than {MAX_USERS} users')
        except ValueError as error:
            raise ValueError(f'{os.fspath(path)}, line {number}: {error}') from error
        users[name] = user
    return users


def _user(line: str) -> tuple[str, _User]:
    name, *rest = line.split(':')
    # the line is not quoted: where it is misplaced, it may hold a password
    if len(rest) != 2:
        raise ValueError('it must be name:role:scrypt$n$r$p$salt$hash')
    name = _normal(name)
    _check_name(name)
    if rest[0] not in [role.value for role in Role]:
        raise ValueError("the role must be 'viewer' or 'operator'")
    return name, _User(Role(rest[0]), _Secret.parse(rest[1]))


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ValueError('a name must have 1 to 64 letters, digits or . _ @ -')


def _normal(text: str) -> str:
    return unicodedata.normalize('NFC', text)


def _brief(name: str) -> str:
    # cut before it is gone through; the last character may yet combine with what is cut off
    return _normal(name[:256])


def _network(address: str) -> str:
    address = address[:64]
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    if found.ipv4_mapped:
        return str(found.ipv4_mapped)
    return str(ipaddress.IPv6Network((int(found), 64), strict=False))


def _place(host: str, scheme: str) -> tuple[str, int] | None:
    """Return name and port of a header Host; None where it is none."""
    if len(host) > _MAX_HEADER or not host.isascii() or scheme not in _PORTS:
        return None
    match = _HOST.fullmatch(host.lower())
    if match is None:
        return None
    return match[1], int(match[2] or _PORTS[scheme])


def _fingerprint(token: str) -> bytes:
    return hashlib.sha256(token.encode(errors='surrogatepass')).digest()


if __name__ == '__main__':
    sys.exit(main())
