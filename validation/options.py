# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the programs of the studies have in common: their options, and work that is spread."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from koopman_ros.execution import Backend, Serial, Tell

Key = TypeVar('Key')
Found = TypeVar('Found')


def add_output(parser: argparse.ArgumentParser, default: str) -> None:
    """Add the option of the folder that is written to."""
    parser.add_argument('--output', type=Path, default=Path(default),
                        help='folder for figures and report (default: %(default)s)')


def add_seeds(parser: argparse.ArgumentParser, default: int = 10) -> None:
    """Add the option that says how many seeds there are."""
    parser.add_argument('--seeds', type=int, default=default,
                        help='number of seeds, at least 1 (default: %(default)s)')


def add_scheduler(parser: argparse.ArgumentParser, default: str = 'joblib') -> None:
    """Add the option that says where runs go."""
    parser.add_argument(
        '--scheduler', default=default, metavar='PLACE', help='where the runs go: joblib for a '
        'process on each core, joblib:N for N of them, tcp://... for the workers of a Dask '
        'scheduler, an empty text for this process (default: '
        f'{"this process" if not default else "%(default)s"})')


def add_plants(parser: argparse.ArgumentParser, plants: Iterable[str]) -> None:
    """Add the arguments that name some of the plants."""
    parser.add_argument('plants', nargs='*', metavar='plant',
                        help=f'which: {", ".join(plants)} (default: all)')


def read(parser: argparse.ArgumentParser, args: list[str] | None, plants: Iterable[str] = ()
         ) -> argparse.Namespace:
    """Read the options; an error says which seeds or plants there cannot be."""
    options = parser.parse_args(args)
    if getattr(options, 'seeds', 1) < 1:
        parser.error(f'--seeds is {options.seeds}, must be at least 1')
    if unknown := set(getattr(options, 'plants', ())) - set(plants):
        parser.error(f'there is no plant {", ".join(sorted(unknown))}: choose of '
                     f'{", ".join(plants)}')
    return options


def over(backend: Backend | None, function: Callable[[Key], Found], keys: Iterable[Key]
         ) -> dict[Key, Found]:
    """
    Return what a function finds of each key, worked where a backend says, by key.

    :param backend: this process by default.
    """
    by_name = {str(key): key for key in keys}
    return {by_name[name]: found for name, found in (backend or Serial()).run(
        _called, by_name, shared=function)}


def _called(function: Callable[[Key], Found], key: Key, _: Tell) -> Found:
    return function(key)
