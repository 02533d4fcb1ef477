# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What pip would install, and what modules import, found without either."""

import ast
from collections.abc import Iterable
from functools import cache
from importlib.metadata import distribution, PackageNotFoundError, packages_distributions
from pathlib import Path
import subprocess
import sys

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]


@cache
def providers() -> dict[str, set[str]]:
    """Return the modules of the installed distributions, each with its distributions."""
    return {module: set(map(canonicalize_name, names))
            for module, names in packages_distributions().items()}


def installed_with(*wanted: str) -> set[str]:
    """
    Return the distributions that pip installs for requirements, e.g. ``koopman_ros[ros]``.

    One that is not installed here counts without its own requirements.
    """
    found: set[tuple[str, str]] = set()
    left = list(map(Requirement, wanted))
    while left:
        requirement = left.pop()
        name = canonicalize_name(requirement.name)
        new = {(name, extra) for extra in ('', *requirement.extras)} - found
        found |= new
        left += [one for one in _requirements(name) if any(
            one.marker is None or one.marker.evaluate({'extra': extra}) for _, extra in new)]
    return {name for name, _ in found}


@cache
def _requirements(name: str) -> list[Requirement]:
    try:
        return [*map(Requirement, distribution(name).requires or ())]
    except PackageNotFoundError:
        return []


def modules_without(distributions: Iterable[str]) -> set[str]:
    """Return the modules installed here that none of the distributions provides."""
    there = set(distributions)
    return {module for module, names in providers().items() if not names & there}


def loaded(modules: str, absent: Iterable[str] = ()) -> set[str]:
    """Import modules where some packages are not installed; return all that were loaded."""
    # None in its place makes the import of a module fail
    program = (f'import sys; sys.modules.update(dict.fromkeys({tuple(absent)!r}))\n'
               f'import {modules}\nprint(*(name for name in sys.modules if sys.modules[name]))')
    result = subprocess.run(
        [sys.executable, '-W', 'error', '-c', program], capture_output=True, text=True,
        timeout=240, check=False, cwd=ROOT)
    assert (result.returncode, result.stderr) == (0, ''), result.stderr
    return set(result.stdout.split())


def imports_of(*modules: str) -> dict[str, str]:
    """
    Return the modules of others that are imported with modules of this tree, each with a place.

    Imports are followed as they stand at the head of a module, and within functions of `studies`
    and `benchmarks`. What functions of the package import is for a use of it that is optional.
    """
    foreign: dict[str, str] = {}
    seen: set[Path] = set()
    left = list(modules)
    while left:
        name = left.pop()
        for path in _files(name):
            if path in seen:
                continue
            seen.add(path)
            for one in _imported(path):
                if _files(one):
                    left.append(one)
                elif one.split('.')[0] not in sys.stdlib_module_names:
                    foreign.setdefault(one.split('.')[0], f'{path.relative_to(ROOT)}')
    return foreign


def modules_of_this_tree(name: str) -> list[str]:
    """Return what Python runs for a module of this tree; nothing for another."""
    if not _is_file(name):
        return []
    return [name, *([f'{name}.__main__'] if _is_file(f'{name}.__main__') else [])]


@cache
def _files(module: str) -> list[Path]:
    """Return the files that the import of a module of this tree runs, its packages' first."""
    parts = module.split('.')
    files = []
    for count in range(1, len(parts) + 1):
        place = ROOT.joinpath(*parts[:count])
        files += [path for path in (place / '__init__.py', place.with_suffix('.py'))
                  if path.is_file()]
    return files


@cache
def _imported(path: Path) -> list[str]:
    """Return the modules that a file imports by the statements that count."""
    found: list[ast.Import | ast.ImportFrom] = []
    left: list[ast.AST] = list(ast.parse(path.read_text()).body)
    while left:
        match node := left.pop():
            case ast.Import() | ast.ImportFrom():
                found.append(node)
            case ast.If(test=ast.Name(id='TYPE_CHECKING')):
                left += node.orelse
            case ast.FunctionDef() if path.is_relative_to(ROOT / 'koopman_ros'):
                pass
            case _:
                left += ast.iter_child_nodes(node)
    return [name for node in found for name in _names(node, path)]


def _names(node: ast.Import | ast.ImportFrom, path: Path) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    assert node.module is not None, path
    # a name may be a module of the package
    return [node.module, *(f'{node.module}.{alias.name}' for alias in node.names
                           if _files(node.module) and _is_file(f'{node.module}.{alias.name}'))]


@cache
def _is_file(module: str) -> bool:
    place = ROOT.joinpath(*module.split('.'))
    return place.with_suffix('.py').is_file() or (place / '__init__.py').is_file()
