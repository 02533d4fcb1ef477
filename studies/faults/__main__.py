# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the campaign: ``python -m studies.faults [case | group | soak ...] [--quick]``."""

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Any

from koopman_ros.testing import deferred_interrupt
from studies.faults import report
from studies.faults.case import FaultCase
from studies.faults.cases import CASES
from studies.faults.endurance import DAYS, HOURS, run_endurance
from studies.faults.harness import run
from studies.faults.plants import PLANTS

# One of each group, quick ones that say much.
QUICK = ('nan-short', 'measurements-lost', 'clock-zero', 'controller-killed', 'bad-values-storm',
         'feed-warm', 'two_tanks-nan-one', 'quadruple_tank-controller-killed')


def main(args: list[str] | None = None) -> int:
    """Run the selected cases and the endurance run; return 1 if one was not survived."""
    groups = dict.fromkeys([*PLANTS, *(case.group for case in CASES.values())])
    parser = argparse.ArgumentParser(
        prog='python -m studies.faults',
        description='Inject faults into the loop, and judge its reaction.')
    parser.add_argument('names', nargs='*', metavar='name',
                        help=f'a case, a plant or group ({", ".join(groups)}), or '
                             f'{", ".join(DAYS)} (default: all)')
    parser.add_argument('--quick', action='store_true', help='eight cases, no soak: a minute')
    parser.add_argument('--list', action='store_true', help='show the cases, and run none')
    parser.add_argument('--hours', type=float, default=HOURS,
                        help='plant time of the endurance run (default: %(default)g)')
    parser.add_argument('--output', type=Path, default=Path('out/faults'),
                        help='folder for the report (default: %(default)s)')
    given = parser.parse_args(args)
    if unknown := [name for name in given.names if name not in {*CASES, *groups, *DAYS}]:
        parser.error(f'there is no case {", ".join(unknown)}: --list shows them')
    if not given.hours > 0.0:
        parser.error(f'--hours is {given.hours} h, must be above 0 h')
    names = given.names or (QUICK if given.quick else [*CASES, *DAYS])
    cases = [case for case in CASES.values()
             if {case.name, case.group, case.on.name}.intersection(names)]
    if given.list:
        print(*(f'{case.name:49s}{case.group:14s}{case.does}' for case in cases), sep='\n')
        return 0
    return _run(cases, [name for name in DAYS if name in names], given.hours, given.output)


def _run(cases: Sequence[FaultCase], days: Sequence[str], hours: float, folder: Path) -> int:
    results: dict[str, dict[str, Any]] = {}
    endured: dict[str, dict[str, Any]] = {}
    try:
        with deferred_interrupt() as check:
            for number, case in enumerate(cases, 1):
                print(f'[{number:2d}/{len(cases)}] {case.name:49s}', end='', flush=True)
                results[case.name], _ = run(case, folder / 'logs' / case.name, check)
                print(report.line(results[case.name]), flush=True)
                report.write(folder, results)
            for name in days:
                endured[name] = run_endurance(folder / 'logs' / name, check, hours, DAYS[name])
                print('\n'.join(endured[name]['reasons']) or 'survived')
    except KeyboardInterrupt:
        print(f'\ninterrupted; the finished cases are in {folder}', file=sys.stderr)
        return 130
    survived = report.write(folder, results, endured)
    print(f'\n{sum(result["survived"] for result in results.values())} of {len(results)} cases '
          f'survived ({report.by_plant(results)}); see {folder / "report.md"}')
    return 0 if survived else 1


if __name__ == '__main__':
    sys.exit(main())
