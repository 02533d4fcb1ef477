# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a name in a parameter stands for: something of the package, or ``module:name`` of any."""

from collections.abc import Callable, Mapping, Sequence
import importlib
import sys
import traceback
from typing import Any

_LONGEST = 200  # characters of an error's text that reach a status


def plug(name: str, kind: str, known: Mapping[str, Callable[..., Any] | str]) -> Any:
    """
    Return what a name stands for: something known, or ``module:name`` of any module.

    :param kind: what it is, for the error, e.g. ``'law'``.
    :param known: by name, itself or as ``module:name``, which is imported only when it is asked
        for.
    :raises ValueError: for a name that stands for nothing that can be called.
    """
    found = known.get(name, name)
    if not isinstance(found, str):
        return found
    module, _, attribute = found.partition(':')
    if not attribute:
        raise ValueError(f'there is no {kind} {name!r}: choose one of {", ".join(known)}, or '
                         'module:name of one of your own')
    try:
        found = getattr(importlib.import_module(module), attribute)
    except BaseException as error:
        raise ValueError(f'the {kind} {name!r} cannot be loaded ({contained(error)}): check '
                         'module and name, and that Python finds the module') from error
    if not callable(found):
        raise ValueError(f'the {kind} {name!r} is a {type(found).__name__}, which cannot be '
                         'called: name a class or a function')
    return found


def plugged(name: str, kind: str, known: Mapping[str, Callable[..., Any] | str],
            arguments: Sequence[Any], members: Sequence[str]) -> Any:
    """
    Return what :func:`plug` finds, called with arguments.

    :param members: attributes that the result must have.
    :raises ValueError: where it cannot be called with the arguments, or lacks a member.
    """
    factory = plug(name, kind, known)
    try:
        made = factory(*arguments)
        missing = [member for member in members if not hasattr(made, member)]
    except ValueError:
        raise
    except BaseException as error:
        raise ValueError(f'the {kind} {name!r} cannot be constructed ({contained(error)}): '
                         'correct its class') from error
    if missing:
        raise ValueError(f'the {kind} {name!r} returned a {type(made).__name__} without '
                         f'{" and ".join(missing)}: correct its class')
    return made


def own_code(value: Any) -> list[str]:
    """Return the names of the form ``module:name`` in the value of a parameter."""
    names = [value] if isinstance(value, str) else list(value)
    return [name for name in names if isinstance(name, str) and ':' in name]


def loaded_class(name: str) -> type[Any]:
    """Return a class by ``module:name`` if its module is loaded; ValueError where it is not."""
    module, _, path = name.partition(':')
    found: Any = sys.modules.get(module)
    for part in path.split('.'):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        raise ValueError(f'the class {name!r} is not known here')
    return found


def contained(error: BaseException) -> str:
    """
    Return in one line what a plug-in raised, whatever it is, also SystemExit.

    :raises KeyboardInterrupt: where that is the error: it is meant for the process.
    """
    if isinstance(error, KeyboardInterrupt):
        raise error
    return ' '.join(''.join(traceback.format_exception_only(error)).split())[:_LONGEST]
