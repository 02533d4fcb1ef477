# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run parts of it: ``python -m validation.benchmarks [part ...] [--quick | --full]``."""

import argparse
from collections.abc import Callable
from functools import partial
import json
from pathlib import Path
import sys
from typing import Any

from koopman_ros.reports import write_figures
from validation.benchmarks.loop import part as loop
from validation.benchmarks.options import Extent, Options
from validation.benchmarks.recording import part as recording
from validation.benchmarks.training import part as training

# A part is a module with a function that returns its figures.
PARTS: dict[str, Callable[[Options], dict[str, Any]]] = {
    'training': training.run, 'recording': recording.run, 'loop': loop.run}


def main(args: list[str] | None = None) -> int:
    """Run the parts asked for, one after the other."""
    parser = argparse.ArgumentParser(
        prog='python -m validation.benchmarks',
        description='Measure the package beside other programs.')
    parser.add_argument('parts', nargs='*', metavar='part',
                        help=f'{", ".join(PARTS)} (default: all)')
    extent = parser.add_mutually_exclusive_group()
    extent.add_argument('--quick', dest='extent', action='store_const', const=Extent.QUICK,
                        help='the smallest cases, about a minute')
    extent.add_argument('--full', dest='extent', action='store_const', const=Extent.FULL,
                        help='all cases with large limits, hours')
    parser.add_argument('--limit', type=float, metavar='SECONDS',
                        help='time limit of one solver in one case of training')
    parser.add_argument('--output', type=Path, default=Path('out/bench'),
                        help='folder for summary.json and pictures (default: %(default)s)')
    given = parser.parse_args(args)
    if unknown := sorted(set(given.parts) - set(PARTS)):
        parser.error(f'there is no part {", ".join(unknown)}: choose from {", ".join(PARTS)}')
    if given.limit is not None and not given.limit > 0.0:
        parser.error(f'--limit is {given.limit} s, must be above 0 s')
    summary = given.output / 'summary.json'
    given.output.mkdir(parents=True, exist_ok=True)
    for part in given.parts or PARTS:
        options = Options(given.output, given.extent or Extent.DEFAULT, given.limit,
                          partial(_write, summary, part))
        try:
            _write(summary, part, PARTS[part](options))
        except KeyboardInterrupt:
            print(f'\ninterrupted; what was finished is in {given.output}', file=sys.stderr)
            return 130
    print(f'\n{summary} holds all figures')
    return 0


def _write(path: Path, part: str, figures: dict[str, Any]) -> None:
    """Put a part's figures in the place of its old ones; those of the other parts stay."""
    before = json.loads(path.read_text()) if path.exists() else {}
    if not isinstance(before, dict):
        raise ValueError(f'{path} does not hold the figures of a benchmark: move it away')
    write_figures(path, {**before, part: figures})


if __name__ == '__main__':
    sys.exit(main())
