# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The one place where a compiled function takes the place of one in numpy; imports nothing.

A function of a model that is worth it is marked by :func:`compilable`, and stays the reference.
A model carries the table of what is compiled, by the names of these functions: empty by default,
and that of :data:`koopman_ros.compiled.KERNELS` where it is asked for. What a compiled function
does not do, for a kind of model or near to a border, the reference does.
"""

from collections.abc import Callable, Mapping
from functools import wraps
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

Kernels = Mapping[str, Callable[..., Any]]
Function = TypeVar('Function', bound=Callable[..., Any])

NUMPY: Kernels = MappingProxyType({})


class Carrier(Protocol):
    """What carries compiled functions: a model."""

    @property
    def kernels(self) -> Kernels:
        """By name; none for numpy."""


def compilable(reference: Function) -> Function:
    """
    Let a compiled function answer, where the model, the first argument, has one by this name.

    That returns None for what it leaves to the reference.
    """
    name = reference.__name__

    @wraps(reference)
    def answer(model: Carrier, *args: Any, **options: Any) -> Any:
        kernel = model.kernels.get(name)
        if kernel is not None:
            found = kernel(model, *args, **options)
            if found is not None:
                return found
        return reference(model, *args, **options)

    return answer  # type: ignore[return-value]
