# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plug-ins by name: a class of the package, or ``module:Class`` of any module."""

from collections.abc import Callable, Mapping
import importlib
import sys
import traceback
from typing import Any, TypeVar

_LONGEST = 200  # characters of an error's text that reach a status

Base = TypeVar('Base')


def load_plugin(name: str, kind: str, known: Mapping[str, Callable[..., Any] | str]) -> Any:
    """
    Return a class or function by its name: a known one, or ``module:name`` of any module.

    :param kind: of plug-in, for the error, e.g. ``'law'``.
    :param known: by name, itself or as ``module:name``, which is imported on first use.
    :raises ValueError: for a name without something that can be called.
    """
    found = known.get(name, name)
    if not isinstance(found, str):
        return found
    module, _, attribute = found.partition(':')
    if not attribute:
        raise ValueError(f'there is no {kind} {name!r}: choose one of {", ".join(known)}, or '
                         'module:name for your own')
    try:
        found = getattr(importlib.import_module(module), attribute)
    except BaseException as error:
        raise ValueError(f'the {kind} {name!r} cannot be loaded ({contained(error)}): check the '
                         'name, and that Python can import the module') from error
    if not callable(found):
        raise ValueError(f'the {kind} {name!r} is a {type(found).__name__}, which is not '
                         'callable: name a class or a function')
    return found


def plugin_class(name: str, kind: str, known: Mapping[str, type[Any] | str], base: type[Base]
               ) -> type[Base]:
    """
    Return the class of a plug-in, see :func:`load_plugin`, which fulfils the contract of its base.

    :raises ValueError: for another class, or one that lacks a method, naming it.
    """
    found = load_plugin(name, kind, known)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f'the {kind} {name!r} is not a subclass of '
                         f'{base.__module__}.{base.__name__}: derive the class from it')
    if missing := sorted(getattr(found, '__abstractmethods__', ())):
        raise ValueError(f'the {kind} {name!r} lacks {", ".join(missing)}: define '
                         f'{"them" if len(missing) > 1 else "it"} in its class')
    return found


def plug_in(name: str, kind: str, known: Mapping[str, type[Any] | str], base: type[Base],
            *arguments: Any) -> Base:
    """
    Return a plug-in, constructed from arguments of which the last is the tuning.

    Its own parameters in the tuning are the last argument of its constructor.

    :raises ValueError: as :func:`plugin_class`, and where it cannot be constructed.
    """
    found: Any = plugin_class(name, kind, known, base)
    try:
        made: Base = found(*arguments, arguments[-1].of_plugin(name, found.Parameters))
        return made
    except ValueError:
        raise
    except BaseException as error:
        raise ValueError(f'the {kind} {name!r} cannot be constructed ({contained(error)}): '
                         'correct the class') from error


def short_name(name: str) -> str:
    """Return the name under which the parameters of a plug-in are declared: that of its class."""
    return name.rpartition(':')[2]


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
        raise ValueError(f'unknown class {name!r}')
    return found


def contained(error: BaseException) -> str:
    """
    Return any exception of a plug-in in one line, also SystemExit.

    :raises KeyboardInterrupt: where that is the error: it is meant for the process.
    """
    if isinstance(error, KeyboardInterrupt):
        raise error
    return ' '.join(''.join(traceback.format_exception_only(error)).split())[:_LONGEST]
