# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run parts of it: ``python -m benchmarks [part ...] [--quick]``."""

import argparse
from importlib import import_module
import json
import os
from pathlib import Path
import sys

from koopman_ros.core.plots import machine, write_figures

# A part has its PLANS by extent, the PACKAGES whose versions matter, and `measure`, which fills
# in the figures of one plan and yields them piece by piece as text.
# It is a module here, imported when it is asked for: most need what the others do without.
PARTS = ('training', 'recording', 'loop')


def main(args: list[str] | None = None) -> int:
    """Run the selected parts, one after the other; the figures of the others stay."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks',
        description='Compare the package with other programs.')
    parser.add_argument('parts', nargs='*', metavar='part',
                        help=f'{", ".join(PARTS)} (default: all)')
    parser.add_argument('--quick', dest='extent', action='store_const', const='quick',
                        default='default', help='the smallest cases, about a minute')
    parser.add_argument('--output', type=Path, default=Path('out/bench'),
                        help='folder for summary.json and pictures (default: %(default)s)')
    given = parser.parse_args(args)
    if unknown := sorted(set(given.parts) - set(PARTS)):
        parser.error(f'there is no part {", ".join(unknown)}: choose from {", ".join(PARTS)}')
    path = given.output / 'summary.json'
    summary = json.loads(path.read_text()) if path.exists() else {}
    if not isinstance(summary, dict):
        parser.error(f'{path} does not hold the figures of a benchmark: move it away')
    for name in given.parts or PARTS:
        part = import_module(f'benchmarks.{name}')
        figures = summary[name] = {'machine': machine(*part.PACKAGES), 'extent': given.extent}
        try:
            for text in part.measure(part.PLANS[given.extent], figures, given.output):
                write_figures(path, summary)
                print(text + '\n', flush=True)
        except KeyboardInterrupt:
            print(f'\ninterrupted; the finished parts are in {given.output}', file=sys.stderr)
            return 130
        figures['machine']['load_at_end'] = os.getloadavg()[0]
        write_figures(path, summary)
    print(f'{path} holds all figures')
    return 0


if __name__ == '__main__':
    sys.exit(main())
