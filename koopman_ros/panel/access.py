# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Users of the panel, their roles, and hashes of their passwords.

``python -m koopman_ros.panel.access FILE NAME ROLE`` reads a password and stores the user.
"""

import argparse
from collections.abc import Mapping, Sequence
import contextlib
from dataclasses import dataclass
import getpass
import os
from pathlib import Path
import re
import secrets
import stat
import sys
import unicodedata

from argon2 import extract_parameters, PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError

from koopman_ros.core.paths import write_atomically
from koopman_ros.panel.files import read_bounded
from koopman_ros.panel.requests import Role

MAX_FILE = 256 * 1024  # bytes
MIN_PASSWORD = 8  # characters
MAX_PASSWORD = 1024

_NAME = re.compile(r'[\w.@-]{1,64}')
_MAX_MEMORY = 256 * 1024  # KiB of argon2 for one log-in
_HASHER = PasswordHasher()


def hashed(password: str) -> str:
    """
    Return the argon2id hash of a password, as the file of users holds it.

    :raises ValueError: for a password that is too short or too long.
    """
    password = normalised(password)
    if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
        raise ValueError(f'a password must have {MIN_PASSWORD} to {MAX_PASSWORD} characters')
    return _HASHER.hash(password)


@dataclass(frozen=True)
class _User:
    role: Role
    secret: str


class Users:
    """The users of a panel; several threads may use it."""

    def __init__(self, users: Mapping[str, _User]) -> None:
        self._users = dict(users)
        # compared for an unknown name, which so takes as long as a known one
        self._decoy = _HASHER.hash(secrets.token_hex())

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> 'Users':
        """
        Read a file with a line ``name:role:hash`` for each user.

        Empty lines and lines that begin with # are skipped.

        :raises ValueError: for a wrong line, with its number, or a file that others can write.
        :raises OSError: for a file that cannot be opened or read.
        """
        return cls(_parsed(_read(path), path))

    def verify(self, name: str, password: str) -> Role | None:
        """Return the role of a user with this password, None for a wrong name or password."""
        if len(password) > MAX_PASSWORD:
            return None
        user = self._users.get(normalised(name[:MAX_PASSWORD]))
        try:
            _HASHER.verify(user.secret if user else self._decoy, normalised(password))
        except (Argon2Error, InvalidHashError, UnicodeEncodeError):
            return None
        return user.role if user else None

    def __len__(self) -> int:
        return len(self._users)


def main(args: Sequence[str] | None = None) -> int:
    """Ask for a password twice, and store the user; return the exit code."""
    parser = argparse.ArgumentParser(
        prog='python -m koopman_ros.panel.access',
        description="Add a user of the operator's panel, or change a password or role.")
    parser.add_argument('file', type=Path, metavar='FILE', help='file of users; may be missing')
    parser.add_argument('name', metavar='NAME', help='letters, digits and . _ @ -')
    parser.add_argument('role', metavar='ROLE', choices=[role.value for role in Role],
                        help='viewer, operator or engineer')
    chosen = parser.parse_args(args)
    try:
        # before the questions
        _check_name(normalised(chosen.name))
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
    Add or replace a user; the file is replaced as a whole, with mode 0600.

    :param secret: hash of :func:`hashed`.
    :raises ValueError: for a wrong name, or a file that :meth:`Users.read` rejects.
    :raises OSError: for a file that cannot be read or written.
    """
    # a link stays one
    target = Path(os.path.realpath(path))
    name = normalised(name)
    line = f'{name}:{role.value}:{secret}'
    if line.split() != [line]:
        raise ValueError('the name and the hash must not contain spaces')
    owner = target.stat() if target.exists() else None
    lines = _read(target).splitlines() if owner else []
    kept = [line for line in lines if normalised(line.partition(':')[0].strip()) != name]
    content = '\n'.join([*kept, line]) + '\n'
    _parsed(content, path)
    write_atomically(target, content.encode(), 0o600)
    if owner is not None:
        # an administrator may change the file of the account that runs the panel
        with contextlib.suppress(PermissionError):
            os.chown(target, owner.st_uid, owner.st_gid)


def _read(path: str | os.PathLike[str]) -> str:
    content, about = read_bounded(Path(path), MAX_FILE)
    if about.st_mode & 0o022:
        raise ValueError(f'{path} is writable by others (mode {stat.S_IMODE(about.st_mode):04o}): '
                         'chmod 600 it, and check its content')
    return content.decode()


def _parsed(text: str, path: str | os.PathLike[str]) -> dict[str, _User]:
    users: dict[str, _User] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith('#'):
            try:
                name, user = _user(line.strip())
                if name in users:
                    raise ValueError(f'user {name!r} already exists')
            except ValueError as error:
                raise ValueError(f'{path}, line {number}: {error}') from error
            users[name] = user
    return users


def _user(line: str) -> tuple[str, _User]:
    # the line is not quoted in the message: it may hold a password
    name, _, rest = line.partition(':')
    role, _, secret = rest.partition(':')
    name = normalised(name)
    _check_name(name)
    if role not in [one.value for one in Role]:
        raise ValueError('the role must be viewer, operator or engineer')
    try:
        memory = extract_parameters(secret).memory_cost
    except InvalidHashError as error:
        raise ValueError('the password must be a hash of argon2: write the user with '
                         'python -m koopman_ros.panel.access FILE NAME ROLE') from error
    if memory > _MAX_MEMORY:
        raise ValueError(f'the hash takes {memory} KiB of memory, at most {_MAX_MEMORY} KiB are '
                         'allowed')
    return name, _User(Role(role), secret)


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ValueError('a name must have 1 to 64 letters, digits or . _ @ -')


def normalised(text: str) -> str:
    """Return a text in the one form of several in which browsers and terminals write it."""
    return unicodedata.normalize('NFC', text)


if __name__ == '__main__':
    sys.exit(main())
