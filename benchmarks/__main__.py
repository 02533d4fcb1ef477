# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Computing time of the law `mpc`, of do-mpc and of casadi's SQP: ``python -m benchmarks``."""

from collections.abc import Iterator
import os
import shutil
import sys
from typing import Any

from benchmarks import pending, planning
from koopman_ros.core.plots import machine, table, write_figures
from studies.campaign import read_options

PACKAGES = ('numpy', 'scipy', 'daqp', 'casadi', 'do-mpc')
MEANING = {
    'plan': 'by plant: processor times in microseconds of each side with 30 intervals, targets '
            'given, and the agreement of their commands',
    'pending_us': f'median processor time of the control step of {pending.PLANT} with 0 and with '
                  f'{pending.PENDING} commands on their way, in turns, by law',
}
_SIDES = {'step': 'control step with `mpc`', 'law': 'the law alone', 'do_mpc': 'do-mpc',
          'sqp': 'SQP of casadi'}
SAMPLES, QUICK_SAMPLES = 800, 80  # timed plans with each lift


def main(args: list[str] | None = None) -> int:
    """Measure plans and steps, print tables and write ``summary.json``."""
    given = read_options(
        args, 'benchmarks', 'Compare the time of a plan with other programs.', 'out/bench',
        flags={'quick': 'fewer plans, and no compiled SQP: a minute'})
    path = given.output / 'summary.json'
    figures: dict[str, Any] = {'machine': machine(*PACKAGES), 'meaning': MEANING}
    try:
        for text in _measured(given.quick, figures):
            figures['machine']['load_at_end'] = os.getloadavg()[0]
            write_figures(path, figures)
            print(text + '\n', flush=True)
    except KeyboardInterrupt:
        print(f'\ninterrupted; the finished figures are in {path}', file=sys.stderr)
        return 130
    print(f'{path} holds all figures')
    return 0


def _measured(quick: bool, figures: dict[str, Any]) -> Iterator[str]:
    """Fill in the figures, and yield a table of each part."""
    samples = QUICK_SAMPLES if quick else SAMPLES
    compiler = None if quick else next(
        filter(None, map(shutil.which, ('cc', 'gcc', 'clang'))), None)
    plans = figures['plan'] = {
        plant: planning.compare(plant, samples, compiler) for plant in planning.SETPOINTS}
    yield table(
        ('plan of 30 intervals', 'by', 'median [ms]', 'p99 [ms]', 'median / law',
         'commands apart [range]'),
        [(f'{plant}, {one["states"]} states', label, *(
            f'{1e-3 * one[f"{side}_cpu_{quantile}_us"]:.2f}' for quantile in ('median', 'p99')),
          f'{one[f"{side}_cpu_median_us"] / one["law_cpu_median_us"]:.2g}',
          f'{one["agreement"].get(side, 0.0):.1e}')
         for plant, one in plans.items() for side, label in _SIDES.items()])
    steps = figures['pending_us'] = {
        law: pending.step_microseconds(law, samples) for law in pending.LAWS}
    none, some = 0, pending.PENDING
    yield table(('step with', f'{none} and {some} commands on their way [ms]', 'ratio'), [
        (law, f'{1e-3 * one[none]:.2f}, {1e-3 * one[some]:.2f}', f'{one[some] / one[none]:.2g}')
        for law, one in steps.items()])


if __name__ == '__main__':
    sys.exit(main())
