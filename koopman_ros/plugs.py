# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plugs by name: those of the package, and those of any module as ``module:attribute``."""

from collections.abc import Callable, Mapping
import importlib
from typing import Any, TypeVar

Plug = TypeVar('Plug', bound=Callable[..., Any])


def plug(name: str, kind: str, known: Mapping[str, Plug]) -> Plug:
    """
    Return what a name stands for.

    :param name: of one of the package, or ``module:attribute`` of an importable module.
    :param kind: what it is, for the error, e.g. ``'law'``.
    :param known: those of the package.
    :raises ValueError: for a name that stands for nothing that can be called.
    """
    if name in known:
        return known[name]
    module, _, attribute = name.partition(':')
    if not attribute:
        raise ValueError(f'there is no {kind} {name!r}: choose one of {", ".join(known)}, or '
                         'module:class of one of your own')
    try:
        found: Plug = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f'the {kind} {name!r} cannot be loaded ({error}): check module and '
                         'class, and that Python finds the module') from error
    if not callable(found):
        raise ValueError(f'the {kind} {name!r} is no class: name one')
    return found
