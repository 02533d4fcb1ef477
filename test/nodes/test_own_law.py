# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Laws of one's own in one file, over ROS: one with a parameter, one that raises, one rejected."""

from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
import pytest

from koopman_ros.nodes import controller
from koopman_ros.testing import Harness
from support.controller_bench import Bench, PURE, STATUS, STEADY
from support.nodes import complaint, run_here, RunNode, value

LAWS = """
from dataclasses import dataclass

from koopman_ros.control.laws import Law, LawResult
from koopman_ros.core.declaration import column, parameter


@dataclass(frozen=True)
class Parameters:
    gain: float = parameter(2.0, 'Proportional gain.', 'K/K', 0.0, 50.0)
    bias: object = column('inputs', 0.0, 'Added to the command.', minimum=-10.0, maximum=10.0)


class Proportional(Law):
    Parameters = Parameters

    def compute(self, estimate, target, memory, interval, previous):
        error = (target.x - estimate.x) * self.model.states.scale
        u = self.model.inputs.to_physical(target.u) + self.parameters.gain * error
        return LawResult(u + self.parameters.bias)


class Raises(Law):
    def compute(self, estimate, target, memory, interval, previous):
        return {}['nothing']


class WithoutCompute(Law):
    pass
"""


@pytest.fixture(autouse=True)
def own_laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'own_laws.py').write_text(LAWS)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_law_acts_by_its_own_parameters_when_the_one_before_raises(
        ros: Harness, run_node: RunNode) -> None:
    bench = Bench(ros, {
        **PURE, 'fallback_order': ['own_laws:Raises', 'own_laws:Proportional', 'linear'],
        'Proportional.gain': 3.0, 'coolant_temperature.rate_limit': 0.0}, run_node=run_node)
    at_rest = bench.measure(STEADY, 2.0).temperature
    assert bench.measure(STEADY + 0.5, 3.0).temperature == pytest.approx(at_rest - 1.5, abs=0.02)
    set_parameters = ros.set_parameters_atomically
    assert set_parameters('controller', **{'Proportional.gain': 1.0}).successful
    assert bench.measure(STEADY + 0.5, 4.0).temperature == pytest.approx(at_rest - 0.5, abs=0.02)
    assert set_parameters('controller', **{
        'Proportional.coolant_temperature.bias': 0.25}).successful
    assert bench.measure(STEADY + 0.5, 5.0).temperature == pytest.approx(at_rest - 0.25, abs=0.02)
    rejected = set_parameters('controller', **{'Proportional.gain': 51.0})
    assert not rejected.successful
    assert 'Proportional.gain = 51.0' in rejected.reason
    status = ros.wait_for_status(STATUS, lambda s: 'KeyError' in s.message)
    assert (status.level, value(status, 'active law')) == (
        DiagnosticStatus.WARN, 'own_laws:Proportional')


def test_a_law_without_compute_is_rejected_at_the_start(
        capfd: pytest.CaptureFixture[str]) -> None:
    assert run_here(controller, fallback_order="['own_laws:WithoutCompute']") == 1
    assert 'lacks compute' in complaint(capfd)
