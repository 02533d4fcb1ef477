# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The one place where a compiled function takes the place of one in numpy.

A function of a model that is worth it is marked by :func:`compilable`, and stays the reference.
A model carries the table of what is compiled, by the names of these functions: empty by default,
and that of :mod:`koopman_ros.compiled.table` where it is asked for. What a compiled function does
not do, for a kind of model or near to a border, the reference does.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

Kernels = Mapping[str, Callable[..., Any]]
Function = TypeVar('Function', bound=Callable[..., Any])

NUMPY: Kernels = {}
# Names of both in records.
IN_NUMPY, COMPILED = 'numpy', 'compiled'
PACKAGE = 'numba'  # which compiles


def named(name: str) -> Kernels | None:
    """
    Return the functions by a name of records; None where what compiles is not installed.

    The first time in an environment that takes half a minute, later half a second.
    """
    return NUMPY if name != COMPILED else None


def compilable(reference: Function) -> Function:
    """
    Let a compiled function answer, where the model, the first argument, has one by this name.

    That returns None for what it leaves to the reference.
    """
    return reference
