# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What CONTRIBUTING says how to add, added from a temporary folder: a law and an estimator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from koopman_ros.control import Controller, exchange, LevelSettings, State, SupervisorSettings
from koopman_ros.estimation import ESTIMATORS
from koopman_ros.plugs import plug
from support.sampled_loops import controller, Reactor

LAW = """
from dataclasses import dataclass
import math

import numpy as np

from koopman_ros.control.laws.base import LawResult, Tuning
from koopman_ros.lifting import LiftedModel


@dataclass(frozen=True)
class Proportional:
    model: LiftedModel
    tuning: Tuning

    def compute(self, estimate, target, limits, memory, interval, deadline=math.inf):
        u = target.u - 2.0 * self.model.input_inverse @ (estimate.x - target.x)
        calls = (memory or 0) + 1
        return LawResult(limits.within(self.model.inputs.to_physical(u)), memory=calls)
"""
ESTIMATOR = """
from koopman_ros.estimation import DisturbanceObserver, Estimate


class Slow(DisturbanceObserver):
    def correct(self, predicted, x, seconds):
        return super().correct(predicted, x, 0.1 * seconds)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_law_of_another_module_controls_and_falls_back(folder: Path) -> None:
    (folder / 'proportional_law.py').write_text(LAW)
    name = 'proportional_law:Proportional'
    usual = controller()
    loop = Reactor(replace(usual, settings=replace(
        usual.settings, supervisor=levels(name, 'sdre'))))
    loop.run(10)
    loop.ask(320.0)
    samples = loop.run(400)
    assert {sample.report.level for sample in samples} == {name}
    assert samples[-1].temperature == pytest.approx(320.0, abs=1e-3)
    # what a law remembers goes in again
    assert loop.loop.state.law_memory == 410
    loop.do(exchange(replace(usual, settings=replace(
        usual.settings, supervisor=levels('sdre', name)))))
    assert loop.run(20)[-1].report.level == 'sdre'


def levels(*laws: str) -> SupervisorSettings:
    return SupervisorSettings(tuple(LevelSettings(law, 0.5) for law in laws), recovery_time=0.0)


def test_estimator_of_another_module_estimates(folder: Path) -> None:
    (folder / 'slow_estimator.py').write_text(ESTIMATOR)
    estimates = []
    for name in ('', 'slow_estimator:Slow'):
        loop = Reactor(controller(estimator=name))
        loop.run(5)
        loop.run(5, lambda kelvin: kelvin + 0.5)
        estimates.append(float(loop.loop.state.estimate.w[0]))
    assert abs(estimates[0]) > 2.0 * abs(estimates[1]) > 0.0


@pytest.mark.parametrize(('name', 'words'), [
    ('nonsense', "there is no estimator 'nonsense': choose one of disturbance_observer"),
    ('no_such_module:Estimator', "'no_such_module:Estimator' cannot be loaded"),
    ('math:nothing', "'math:nothing' cannot be loaded"),
    ('math:pi', "'math:pi' is no class"),
])
def test_names_that_stand_for_nothing_are_refused(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        plug(name, 'estimator', ESTIMATORS)
    with pytest.raises(ValueError, match=words):
        Controller(controller().model, replace(controller().settings, estimator=name)).step(
            State(), np.array([320.0]), 10 ** 9)
