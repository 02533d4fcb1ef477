# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What both acts do on the terminal: options, a live table, and what came of them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
import sys
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from koopman_ros.demo.loop import Row
from koopman_ros.testing import reserved_output

_COLUMNS = ('time [min]', 'temperature [°C]', 'set-point [°C]', 'error [K]', 'coolant [°C]')


def read_options(args: list[str] | None, description: str | None, output: str, speed: float
                 ) -> argparse.Namespace:
    """Read `output` and `speed` from a command line, with these defaults."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument('--output', type=Path, default=Path(output),
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--speed', type=float, default=speed,
                        help='simulated seconds per second, 0 for as fast as the machine can '
                        '(default: %(default)s)')
    return parser.parse_args(args)


def run_act(act: Callable[[Path, float], Mapping[str, object]], options: argparse.Namespace,
            errors: tuple[type[Exception], ...], files: str) -> int:
    """Run a demo, say what came of it or which of `errors`, and return the exit code."""
    try:
        with reserved_output(options.output) as output:
            if output != options.output:
                print(f'another run writes to {options.output}: this one writes to {output}',
                      flush=True)
            result = act(output, options.speed)
    except errors as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('demo: interrupted; what was recorded is kept', file=sys.stderr)
        return 130
    for key, value in result.items():
        print(f'{key}: {value:.6g}' if isinstance(value, float) else f'{key}: {value}')
    print(f'wrote {output}/{files}')
    return 0


class LiveTable:
    """Show a run as it happens, with a row each `row_period` seconds of plant time."""

    def __init__(self, title: str, row_period: float = 30.0) -> None:
        self._title = title
        self._row_period = row_period
        self._console = Console()
        self._rows: list[tuple[str, ...]] = []
        self._next = 0.0
        self._live = Live(self._table(None), console=self._console, refresh_per_second=10,
                          transient=False) if self._console.is_terminal else None

    def show(self, row: Row) -> None:
        """Show an answered measurement; on a terminal the last line follows every one."""
        cells = _cells(row)
        due = row.seconds >= self._next
        if due:
            self._next = row.seconds + self._row_period
            self._rows.append(cells)
        if self._live is not None:
            self._live.update(self._table(None if due else cells))
        elif due:
            print('  '.join(f'{name} {cell}' for name, cell in zip(_COLUMNS, cells, strict=True)),
                  flush=True)

    def announce(self, text: str) -> None:
        """Say what happens now."""
        if self._live is not None:
            self._rows.append((text, *[''] * (len(_COLUMNS) - 1)))
            self._live.update(self._table(None))
        else:
            print(text, flush=True)

    def _table(self, present: tuple[str, ...] | None) -> Table:
        table = Table(title=self._title, title_justify='left')
        for column in _COLUMNS:
            table.add_column(escape(column), justify='right')
        for cells in self._rows:
            table.add_row(*cells)
        if present is not None:
            table.add_row(*present, style='bold')
        return table

    def __enter__(self) -> LiveTable:
        if self._live is not None:
            self._live.start()
        else:
            print(self._title, flush=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()


def _cells(row: Row) -> tuple[str, ...]:
    setpoint, error = ('', '') if row.setpoint is None else (
        f'{row.setpoint:.3f}', f'{row.temperature - row.setpoint:+.4f}')
    return (f'{row.seconds / 60.0:.1f}', f'{row.temperature:.4f}', setpoint, error,
            f'{row.coolant:.3f}')
