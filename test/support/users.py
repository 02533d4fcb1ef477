# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Users of a panel, whose hashes are quick to verify."""

from pathlib import Path

from argon2 import PasswordHasher

from koopman_ros.panel.access import Role, write_user

PASSWORDS = {'anna': 'correct horse', 'otto': 'battery staple', 'olga': 'staple battery'}


def write_users(path: Path) -> Path:
    """Write a file of users, of which only otto is a viewer; return its path."""
    for name, password in PASSWORDS.items():
        role = Role.VIEWER if name == 'otto' else Role.OPERATOR
        write_user(path, name, role, PasswordHasher(1, 8, 1).hash(password))
    return path
