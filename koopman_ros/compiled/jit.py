# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How functions are compiled: once, when they are first needed, and kept on disk."""

from collections.abc import Callable
import hashlib
import os
from pathlib import Path
from typing import Any

import numba
from numba import config, types

__all__ = [
    'FOLDER', 'INTEGERS', 'MATRIX', 'NUMBER', 'ROOM', 'SIZE', 'VECTOR', 'compiled', 'inner',
    'typed']

VECTOR, MATRIX = (
    types.Array(types.float64, dimensions, 'C', readonly=True) for dimensions in (1, 2))
INTEGERS = types.Array(types.int64, 1, 'C', readonly=True)
ROOM = types.Array(types.float64, 2, 'C')  # a matrix to write to
NUMBER, SIZE = types.float64, types.int64


def _folder() -> Path:
    """
    Return where compiled code is kept.

    A function is found by the time stamp of its own file; what it calls is in others. So there is
    a folder for each state of all of them.
    """
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob('*.py')):
        digest.update(source.read_bytes())
    base = os.environ.get('NUMBA_CACHE_DIR') or os.path.join(
        os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache'), 'koopman_ros')
    return Path(base) / digest.hexdigest()[:16]


FOLDER = _folder()
config.CACHE_DIR = str(FOLDER)

# Divisions by 0 give infinity as in numpy: what is not finite is refused by its results. Sums may
# be taken in another order, several numbers at once. C does not call them, nor Python the inner
# ones.
_HOW: dict[str, Any] = {
    'error_model': 'numpy', 'fastmath': {'reassoc', 'contract'}, 'no_cfunc_wrapper': True}
_INNER: dict[str, Any] = {**_HOW, 'no_cpython_wrapper': True}


def compiled(*arguments: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function for arguments of these types, now, or take it from the disk."""
    found: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(
        tuple(arguments), cache=True, **_HOW)
    return found


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let compiled functions call a function, compiled for each kind of arguments they have."""
    found: Callable[..., Any] = numba.njit(**_INNER)(function)
    return found


def typed(*arguments: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Let them call a function that is compiled once, and kept, for what becomes these types."""
    found: Callable[[Callable[..., Any]], Callable[..., Any]] = numba.njit(
        tuple(arguments), cache=True, **_INNER)
    return found
