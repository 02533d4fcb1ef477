# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `learn` and `bench` requirements): table, figures, records, models."""

from collections.abc import Sequence
import contextlib
from functools import partial
from importlib.util import find_spec
import json
from pathlib import Path
import sys
import time
from typing import Any
import warnings

import numpy as np
import pandas as pd

from koopman_ros import learn_files
from koopman_ros.core.arrays import Array
from koopman_ros.core.plots import bullets
from koopman_ros.learning import simulate
from koopman_ros.model import load
from koopman_ros.records import read
from studies import report
from studies.campaign import (
    Campaign,
    conclude,
    Experiment,
    Metrics,
    Models,
    read_options,
    run_campaign,
)
from studies.records.baselines import BASELINES, chosen, Data
from studies.records.dead_times import one_plant, PLANTS
from studies.records.sets import RecordSet, SETS
from studies.records.table import OWN, table_of

_HELP = 'docs/results/records.md says where each public record is to be had'


def learned(one: RecordSet, files: Sequence[Path], folder: Path, seed: int
            ) -> tuple[Metrics, Models]:
    """Learn by the command with its defaults; return the figures of the free run on the test."""
    output = folder / f'seed_{seed}.safetensors'
    *train, test = map(str, files)
    with (output.with_suffix('.log').open('w') as log, contextlib.redirect_stdout(log),
          contextlib.redirect_stderr(log)):
        begin = time.process_time()
        status = learn_files.main([
            *train, '--states', *one.states, '--inputs', *one.inputs, '--test', test,
            '--training_seed', str(seed), '--model_output', str(output)])
        seconds = time.process_time() - begin
    if status == 1:
        raise ValueError(output.with_suffix('.log').read_text().splitlines()[-1])
    summary = json.loads(output.with_suffix('.json').read_text())
    if not summary['model_file']:
        return {'accepted': False, 'seconds': seconds}, {}
    run = simulate(load(summary['model_file']), read(test, one.states, one.inputs), one.init)
    return {'accepted': status == 0, 'seconds': seconds,
            'error': dict(zip(run.names, run.rmse.tolist(), strict=True)),
            'fit': dict(zip(run.names, run.fit.tolist(), strict=True))}, {}


def by_baseline(one: RecordSet, files: Sequence[Path], name: str, _: int
                ) -> tuple[Metrics, Models]:
    """Return the figures of another method; its sample is the longest of the records."""
    frames = [pd.read_csv(file) for file in files]
    periods = [float(np.median(np.diff(frame.iloc[:, 0]))) for frame in frames]
    frames = [frame[::max(1, round(max(periods) / period))]
              for frame, period in zip(frames, periods, strict=True)]
    raw: list[Data] = [(frame[[*one.inputs]].to_numpy(), frame[[*one.states]].to_numpy())
                       for frame in frames]
    if one.above_first:
        raw = [(u, y - y[0]) for u, y in raw]
    together = [np.concatenate(parts) for parts in zip(*raw[:-1], strict=True)]
    *records, (u, y) = [tuple((values - every.mean(axis=0)) / every.std(axis=0)
                              for values, every in zip(data, together, strict=True))
                        for data in raw]
    begin = time.process_time()
    with warnings.catch_warnings(), np.errstate(all='ignore'):
        warnings.simplefilter('ignore')
        run, options = chosen(BASELINES[name], records, one.init)
        errors = (run(u, y[:one.init]) - y)[one.init:]
    squares = np.nan_to_num(np.mean(errors ** 2, axis=0), nan=np.inf)
    names = [state.partition(' ')[0] for state in one.states]

    def of(values: Array) -> dict[str, float | bool | None]:
        return dict(zip(names, values.tolist(), strict=True))

    return {'seconds': time.process_time() - begin, 'options': {**options},
            'error': of(together[1].std(axis=0) * np.sqrt(squares)),
            'fit': of(100.0 * (1.0 - np.sqrt(squares) / y[one.init:].std(axis=0)))}, {}


def campaign_of(names: Sequence[str], folder: Path, output: Path, seeds: int, scheduler: str,
                dead_times: bool) -> Campaign:
    """Write the records as files, and run every method on them."""
    own: dict[str, Experiment] = {}
    others: dict[str, Experiment] = {}
    for name in names:
        place, one = output / name, SETS[name]
        place.mkdir(parents=True, exist_ok=True)
        train, test = one.frames(folder)
        files = [*(place / f'train_{k}.csv' for k in range(1, 1 + len(train))), place / 'test.csv']
        for file, frame in zip(files, [*train, test], strict=True):
            frame.to_csv(file, index=False)
        own[f'{name}/{OWN}'] = partial(learned, one, files, place)
        others |= {f'{name}/{method}': partial(by_baseline, one, files, method)
                   for method, baseline in BASELINES.items() if find_spec(baseline.package)}
    campaign = run_campaign(1, others, scheduler)
    further = [(seeds, own)]
    if dead_times:
        further.append((PLANTS, {'dead_times': one_plant}))
    for count, experiments in further:
        # an interrupt ends them all
        if campaign.complete:
            campaign.add(run_campaign(count, experiments, scheduler))
    return campaign


def main(args: list[str] | None = None) -> int:
    """Run the sets that are there."""
    options = read_options(
        args, 'studies.records', 'Learn models of measured records with default settings, '
        'compared with other methods.', 'out/studies-records', 3, 'joblib', SETS,
        records='../shared/records')
    if not options.records.is_dir():
        print(f'there is no folder {options.records}: give it by RECORDS=folder; {_HELP}. '
              'Simulated records only.', file=sys.stderr)
    names = []
    for name in options.plants or SETS:
        missing = [file for file in SETS[name].files if not (options.records / file).is_file()]
        if not missing:
            names.append(name)
        elif options.records.is_dir():
            print(f'{name} is left out, without {", ".join(missing)}: {_HELP}', file=sys.stderr)

    def written(_: Campaign, summary: dict[str, Any]) -> None:
        text = table_of(summary)
        print(text)
        report.write(options.output, 'Measured records', [
            report.opening(summary), text, bullets(
                f'{name}: published {SETS[name].published}' for name in names
                if SETS[name].published), 'Options of the other methods are those with the best '
            'free run on held-out data; `summary.json` has them.'],
            packages=(*report.PACKAGES, 'nfoursid', 'sysidentpy', 'pykoop'))

    return conclude(options.seeds, options.output, lambda: campaign_of(
        names, options.records, options.output, options.seeds, options.scheduler,
        not options.plants), written)


if __name__ == '__main__':
    sys.exit(main())
