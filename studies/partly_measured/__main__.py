# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `demo`, `mpc` and `bench` requirements): table, figures, picture."""

from collections.abc import Callable
import sys

from koopman_ros.core.plots import machine, write_figures
from studies import report
from studies.campaign import read_options
from studies.partly_measured.cases import CASES
from studies.partly_measured.contenders import Contender, LINEAR, OWN
from studies.partly_measured.dompc import WithFilter, WithWindow
from studies.partly_measured.report import draw, figures_of, table_of
from studies.partly_measured.study import judge, run

CONTENDERS: dict[str, Callable[..., Contender]] = {
    **OWN, 'do-mpc with its MHE': WithWindow, 'do-mpc, same filter': WithFilter, **LINEAR}
_PACKAGES = ('numpy', 'casadi', 'do-mpc', 'daqp', 'control')


def main(args: list[str] | None = None) -> int:
    """Run every controller on every plant from several seeds."""
    options = read_options(
        args, 'studies.partly_measured', 'Control partly measured plants, compared with do-mpc '
        'and an LQG.', 'out/studies-partial', 10, plants=CASES)
    found = {}
    for plant in options.plants or CASES:
        case = CASES[plant]
        found[plant] = {name: [
            (made, judge(case, made)) for made in (
                run(case, make(case), seed) for seed in range(options.seeds))]
            for name, make in CONTENDERS.items()}
        print(f'{plant} is done', file=sys.stderr, flush=True)
    figures = {plant: {name: figures_of(runs) for name, runs in contenders.items()}
               for plant, contenders in found.items()}
    text = table_of(figures, CASES)
    write_figures(options.output / 'summary.json', {
        'machine': machine(*_PACKAGES), 'seeds': options.seeds, 'plants': figures})
    picture = draw(found, CASES, options.output / 'partly_measured.png')
    report.write(options.output, 'Plants measured in part', [text], [picture], _PACKAGES)
    print(f'{options.seeds} seeds; processor time of a step with its estimator\n\n{text}\n\n'
          f'{options.output} holds all figures and a picture')
    return 0


if __name__ == '__main__':
    sys.exit(main())
