# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Users of a panel, whose hashes are quick to verify."""

from pathlib import Path

from argon2 import PasswordHasher

from koopman_ros.panel.access import write_user
from koopman_ros.panel.requests import Role

PASSWORDS = {'anna': 'correct horse', 'otto': 'battery staple', 'olga': 'staple battery'}


def write_users(path: Path) -> Path:
    """Write a file of users: an engineer, a viewer and an operator; return its path."""
    for name, password in PASSWORDS.items():
        role = {'anna': Role.ENGINEER, 'otto': Role.VIEWER}.get(name, Role.OPERATOR)
        write_user(path, name, role, PasswordHasher(1, 8, 1).hash(password))
    return path
