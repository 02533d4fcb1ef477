# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
LAPACK and BLAS as scipy brings them, without the rest of scipy.linalg.

That loads a hundred modules beside, among them numpy's tools for tests and for Fortran: a fifth of
the processor time of a controller until its first command, and 12 MB of memory.
"""

from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
import sys
from typing import Any

__all__ = ['blas', 'lapack']


def _extension(package: str, name: str) -> Any:
    """Load one extension module of a package without the package; ImportError if it has none."""
    full = f'{package}.{name}'
    if full in sys.modules:
        return sys.modules[full]
    root, *parts = package.split('.')
    # finds the package, and does not import it
    found = find_spec(root)
    folders = found.submodule_search_locations if found is not None else None
    spec = PathFinder.find_spec(
        full, [str(Path(folder, *parts)) for folder in folders or ()])
    if spec is None or spec.loader is None:
        raise ImportError(f'there is no {full}', name=full)
    # it is there under its own name from now on, so that the package takes it when it comes
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


try:
    lapack = _extension('scipy.linalg', '_flapack')
    blas = _extension('scipy.linalg', '_fblas')
except ImportError:
    # the same functions, where another scipy keeps them elsewhere
    from scipy import linalg

    lapack, blas = linalg.lapack, linalg.blas
