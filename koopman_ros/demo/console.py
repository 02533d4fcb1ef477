# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The terminal of the demos: options, a table of the run, and the figures at the end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
import sys

from koopman_ros.core.units import SECONDS_PER_MINUTE, shown, unit_label
from koopman_ros.demo.loop import Row
from koopman_ros.parameters.signal_topics import Signals
from koopman_ros.testing import HarnessError, reserved_output

_ROWS = 20  # in the table of a run
_IN_MINUTES = 300.0  # s; a longer run is shown in minutes


def read_options(args: list[str] | None, description: str | None, output: str, speed: float,
                 plant: str = '', seeds: int = 0) -> argparse.Namespace:
    """Read `output`, `speed` and, where there is a choice, `plant` and `seeds`; the defaults."""
    parser = argparse.ArgumentParser(description=description)
    of = f', of another plant {output}-PLANT' if plant else ''
    parser.add_argument('--output', type=Path,
                        help=f'output folder (default: {output}{of})')
    if plant:
        parser.add_argument('--plant', default=plant,
                            help='bundled plant: the name of a file in config/plants (default: '
                                 '%(default)s)')
        parser.add_argument('--panel', action='store_true',
                            help='run with the panel until Ctrl-C; the address is printed')
        parser.add_argument('--export', action='store_true',
                            help='run the exported C code next to the controller')
        parser.add_argument('--port', type=int, default=8080,
                            help='port of the panel; 0: any free one (default: %(default)s)')
    parser.add_argument('--speed', type=float, default=speed,
                        help='simulated seconds per second; 0: as fast as possible (default: '
                             '%(default)s)')
    if seeds:
        parser.add_argument('--seeds', type=int, default=seeds,
                            help='number of runs with different noise (default: %(default)s)')
    options = parser.parse_args(args)
    if seeds and options.seeds < 1:
        parser.error(f'--seeds is {options.seeds}, must be at least 1')
    if options.output is None:
        other = plant and options.plant != plant
        options.output = Path(f'{output}-{options.plant}' if other else output)
    return options


def run_demo(demo: Callable[[Path, float], Mapping[str, object]], options: argparse.Namespace,
             files: str) -> int:
    """Run a demo, print its figures or why it failed, and return the exit code."""
    try:
        with reserved_output(options.output) as output:
            if output != options.output:
                print(f'another run is writing to {options.output}: writing to {output}',
                      flush=True)
            result = demo(output, options.speed)
    except (HarnessError, OSError, ValueError) as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('demo: interrupted; the recording is kept', file=sys.stderr)
        return 130
    for key, value in result.items():
        print(f'{key}: {value:.6g}' if isinstance(value, float) else f'{key}: {value}')
    print(f'wrote {output}/{files}')
    return 0


class LiveTable:
    """
    Print a run as it happens: a title, the heads of the columns, and about twenty rows.

    :param signals: those of its loop.
    :param duration: of the run in s of plant time.
    """

    def __init__(self, title: str, signals: Signals, duration: float) -> None:
        self._period, self._next, self._signals = duration / _ROWS, 0.0, signals
        unit, self._time = ('min', SECONDS_PER_MINUTE) if duration >= _IN_MINUTES else ('s', 1.0)
        heads = [f'time [{unit}]', *(
            f'{name} [{unit_label(unit)}]' for name, unit in signals.states.items()), *(
            f'{name} set-point [{unit_label(signals.states[name])}]'
            for name in signals.controlled), *(
            f'{name} [{unit_label(unit)}]' for name, unit in signals.inputs.items())]
        self._widths = [max(8, len(head)) for head in heads]
        print(title)
        self._print(heads)

    def show(self, row: Row) -> None:
        """Print an answered measurement where a row is due."""
        if row.seconds < self._next:
            return
        self._next = row.seconds + self._period
        states, inputs = self._signals.states, self._signals.inputs
        self._print([f'{row.seconds / self._time:.1f}', *(
            f'{shown(row.measured[name], unit):.4f}' for name, unit in states.items()), *(
            f'{shown(row.setpoints[name], states[name]):.4f}' if name in row.setpoints else ''
            for name in self._signals.controlled), *(
            f'{shown(row.commanded[name], unit):.4f}' for name, unit in inputs.items())])

    def _print(self, cells: Sequence[str]) -> None:
        print('  '.join(map(str.rjust, cells, self._widths)), flush=True)
