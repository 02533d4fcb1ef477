# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Result of a training, and its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
import os

import numpy as np

from koopman_ros.core.arrays import Array, short_repr, show_printed
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.plots import finite
from koopman_ros.core.units import SECONDS_PER_TIME_UNIT
from koopman_ros.learning.acceptance import AcceptanceResult, PlantAcceptance
from koopman_ros.learning.free_run import FreeRun
from koopman_ros.learning.identification import DriftModel, Identified, LaggedDrift
from koopman_ros.learning.model_selection import ClassComparison, ModelCandidate
from koopman_ros.learning.record import Reduction
from koopman_ros.learning.task import TrainingTask
from koopman_ros.model import COMMANDED, LiftedModel, save
from koopman_ros.records import ImportReport


def _of_plant(about: PlantAcceptance) -> dict[str, object]:
    """Return the figures of the closed loops on plausible plants."""
    test, held = about.test, about.held
    return {
        'plausible_plants': len(test.loops), 'plausible_loops': int(np.sum(test.loops)),
        'plausible_loops_failed': int(np.sum(test.failed)),
        'failing_share_at_most': test.share[1],
        'range_held': dict(zip(held.names, map(float, held.recorded), strict=True)),
        'setpoints_held': {name: float(share) for name, share in held.requested.items()},
        'corrections': dict(about.causes)}


@dataclass(frozen=True)
class TrainingResult:
    """
    Result of a training.

    It is made by :func:`learn`, and prints structure, verdict and errors in a free run.

    >>> result.accepted, result.reasons
    (True, ())
    >>> result.model.inputs.names
    ('pump',)
    """

    task: TrainingTask  #: the task
    account: ImportReport  #: counts of used and dropped measurements
    found: Identified  #: the estimated drift
    #: the classes that were learned, None when there is no model worth judging
    learned: ClassComparison | None
    decision: AcceptanceResult | None  #: its figures, None without a lift
    reasons: tuple[str, ...]  #: why it was rejected; empty when it was accepted
    #: share of the cells of two signals' ranges that the episodes visit, for all pairs of signals
    coverage: Mapping[tuple[str, str], float]
    plant: PlantDescription  #: names, units and nominal point; its time unit is that of the drift
    present: LiftedModel | None  #: the lift that was in use, where there was one
    model_file: str = ''  #: where the lift was written, or an empty string
    #: models of other drifts that explain the record equally well
    alternative_files: tuple[str, ...] = ()
    reduction: Reduction | None = None  #: the part of a long record that is used
    #: of the new model, by record: ``'record'`` for that it was learned from, ``'test'``
    free_runs: Mapping[str, FreeRun] = field(default_factory=dict)
    #: the same of the estimated drift and of the best linear model, by model and record
    compared_runs: Mapping[str, Mapping[str, FreeRun]] = field(default_factory=dict)

    __repr__ = short_repr
    _repr_pretty_ = show_printed

    def __str__(self) -> str:
        """Show the structure, the verdict, the free runs and the warnings."""
        return '\n'.join([
            f'{self.task.plant}: {self.found_text}: {self.verdict}',
            *(f'reason: {one}' for one in self.reasons),
            *(f'{name}: {run}' for name, run in self.free_runs.items()),
            *filter(None, [self.decision.statement if self.decision else '']),
            *(f'warning: {one}' for one in self.warnings)])

    @property
    def model(self) -> LiftedModel:
        """
        The model, accepted or not.

        :raises ValueError: where none was learned, with the reasons.
        """
        if self.learned is None:
            raise ValueError('no model was learned: ' + '; '.join(self.reasons))
        return self.learned.model

    @property
    def found_text(self) -> str:
        """Structure, unmeasured states, dead times, lags and offsets of episodes, in a line."""
        hidden, names = self.found.hidden, self.found.drift.box.inputs.names
        late = [f'{what} {seconds:.4g} s of {name}' for what, values in (
            ('dead time', self.dead_time), ('lag', self.lag))
            for name, seconds in zip(names, values.tolist(), strict=True) if seconds > 0.0]
        return ', '.join([
            self.found.drift.form, f'{hidden or "no"} unmeasured state{"s" * (hidden > 1)}',
            *(late or ['no dead time']),
            *([f'a constant disturbance of each episode ({self._shift_text})'] if len(
                self.found.offsets) else [])])

    @property
    def _shift_text(self) -> str:
        """By how much the disturbances of the episodes move the measured states."""
        states, shifts = self.found.drift.box.states, self.found.shifts
        return '; '.join(
            f'{name} by {", ".join(f"{value:+.3g}" for value in column.tolist())} {unit}'
            for name, unit, column in zip(states.names, states.units, shifts.T, strict=False)
            if np.isfinite(column).all()) or 'the states drift away by it'

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write the model file, with the verdict in it.

        :param path: ending in ``.safetensors``.
        """
        save(self.model, path)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the record and the model, accepted or not."""
        return (*self.account.warnings(), *(self.decision.warnings if self.decision else ()))

    @property
    def accepted(self) -> bool:
        """Whether the lift may be used."""
        return not self.reasons

    @property
    def verdict(self) -> str:
        """``'accepted'``, ``'rejected'``, or ``'unfinished'`` after an interrupt."""
        return 'accepted' if self.accepted else (
            'unfinished' if self.learned and self.decision is None else 'rejected')

    @property
    def model_class(self) -> str:
        """The class of the model."""
        return 'none learned' if self.learned is None else self.learned.chosen.name

    @property
    def dead_time(self) -> Array:
        """Dead times (n_u,) of the inputs, in s."""
        return SECONDS_PER_TIME_UNIT[self.plant.time_unit] * self.found.dead_time

    @property
    def lag(self) -> Array:
        """Lags (n_u,) of the inputs, in s."""
        drift = self.found.drift
        if not isinstance(drift, LaggedDrift):
            return np.zeros(len(drift.box.inputs))
        own = [COMMANDED + name not in drift.box.states.names for name in drift.box.inputs.names]
        return SECONDS_PER_TIME_UNIT[self.plant.time_unit] * drift.lag * own

    def summary(self) -> dict[str, object]:
        """
        Return the figures by name, for a JSON file.

        None is an error that is infinite, and the verdict of a training that was interrupted.
        """
        box = self.found.drift.box
        states, inputs = box.states, box.inputs
        gains = self.found.drift.input_matrix / SECONDS_PER_TIME_UNIT[self.plant.time_unit]

        def by_state(values: Array) -> dict[str, float]:
            return dict(zip(states.names, map(float, values), strict=True))

        def of_class(one: ModelCandidate) -> dict[str, object]:
            about: dict[str, object] = {
                'chosen': self.learned is not None and one is self.learned.chosen,
                'rejection': one.rejection, 'limit': one.limit, 'seconds': one.seconds,
                'steps': one.steps}
            if one.figures and one.law_check:
                assert one.figures.rollout_rmse is not None
                about |= {
                    'heldout_rx': one.figures.fit.rx,
                    'heldout_error': by_state(one.figures.rollout_rmse),
                    'beyond_noise': one.excess,
                    'closed_loops': one.law_check.loops,
                    'closed_loops_failed': int(np.sum(one.law_check.failed)),
                    'closed_loop_cost_over_linear': one.law_check.median_ratio}
            return about

        figures: dict[str, object] = {
            'accepted': None if self.verdict == 'unfinished' else self.accepted,
            'found': self.found_text,
            'model_class': self.model_class,
            'reasons': list(self.reasons),
            'warnings': list(self.warnings),
            'model_file': self.model_file,
            'alternative_files': list(self.alternative_files),
            'units': dict(zip((*states.names, *inputs.names), (*states.units, *inputs.units),
                              strict=True)),
            'measurements_read': self.account.measurements,
            'measurements_used': self.account.used,
            'reduction': None if self.reduction is None else asdict(self.reduction),
            'coverage': {', '.join(pair): share for pair, share in self.coverage.items()},
            'derivative_method': self.found.method,
            'drift': self.found.drift.form,
            'structure_search': list(self.found.steps),
            'drift_degree': (
                self.found.drift.degree if isinstance(self.found.drift, DriftModel) else None),
            'input_gain': {name: dict(zip(inputs.names, map(float, row), strict=True))
                           for name, row in zip(states.names, gains, strict=True)},
            'noise': by_state(self.found.noise),
            'dead_time': dict(zip(inputs.names, self.dead_time.tolist(), strict=True)),
            'lag': dict(zip(inputs.names, self.lag.tolist(), strict=True)),
            'characteristics': {name: [one.values.tolist(), one.effects.tolist()]
                                for name, one in self.found.drift.characteristics.items()},
            'constants': {one.name: {
                'value': one.value, 'standard_error': one.standard_error,
                'unit': one.unit, 'lower': one.lower, 'upper': one.upper,
                'standing': one.standing.name.lower(), 'text': str(one)}
                for one in self.found.constants},
        }
        if self.learned:
            figures['classes'] = {one.name: of_class(one) for one in self.learned.contenders}
        if self.decision and self.learned:
            trained, fit = self.learned.model.states, self.learned.figures.fit
            check = self.decision.law_check
            figures |= {
                'trained_from': by_state(trained.lower),
                'trained_to': by_state(trained.upper),
                'heldout_error': by_state(self.decision.rmse),
                'heldout_error_of_current_model': None if self.decision.current_rmse is None else (
                    by_state(self.decision.current_rmse)),
                'heldout_error_of_linear_model': by_state(self.decision.linear_rmse),
                **({} if self.decision.plant is None else {
                    'rate_error': by_state(trained.scale * self.decision.plant.band.error)}),
                'heldout_rw': fit.rw,
                'heldout_rx': fit.rx,
                'condition': fit.cond,
                'closed_loops': check.loops,
                'closed_loop_statement': self.decision.statement,
                **({} if self.decision.plant is None else _of_plant(self.decision.plant)),
                'closed_loops_arrived': check.arrived,
                'closed_loops_failed': int(np.sum(check.failed)),
                'closed_loop_cost_over_linear': check.median_ratio,
                'worst_closed_loop_cost_over_linear': check.worst_ratio,
            }

        def of_runs(runs: Mapping[str, FreeRun]) -> dict[str, object]:
            return {name: {'error': dict(zip(run.names, map(float, run.rmse), strict=True)),
                           'fit_percent': dict(zip(run.names, map(float, run.fit), strict=True))}
                    for name, run in runs.items()}

        figures['free_runs'] = of_runs(self.free_runs)
        figures['free_runs_of'] = {name: of_runs(runs)
                                   for name, runs in self.compared_runs.items()}
        finite_figures: dict[str, object] = finite(figures)
        return finite_figures
