# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Control laws of one's own over ROS: own parameters, one that raises, one that is incomplete."""

from pathlib import Path
import sys

from diagnostic_msgs.msg import DiagnosticStatus
import pytest
from rcl_interfaces.srv import DescribeParameters

from koopman_ros.testing import Harness
from support.controller_bench import Bench, PURE, STEADY
from support.nodes import value

LAWS = """
from dataclasses import dataclass

from koopman_ros.control.laws.base import Law, LawResult
from koopman_ros.declaration import parameter


@dataclass(frozen=True)
class Gain:
    gain: float = parameter(0.5, 'Proportional gain.', '', 0.0, 10.0)


class Proportional(Law):
    Parameters = Gain

    def compute(self, estimate, target, memory, interval, previous):
        u = target.u - self.parameters.gain * (estimate.x - target.x)
        return LawResult(self.model.inputs.to_physical(u))


class Raising(Law):
    def compute(self, estimate, target, memory, interval, previous):
        raise SystemExit('out of order')


class Incomplete(Law):
    pass
"""


def program(folder: Path) -> tuple[str, ...]:
    """Return a controller that finds the laws."""
    (folder / 'own_laws.py').write_text(LAWS)
    return (sys.executable, '-c', f'import sys; sys.path.insert(0, {str(folder)!r})\n'
            'from koopman_ros.nodes.controller import main\nsys.exit(main())')


def test_a_law_that_raises_gives_way_to_one_with_its_own_parameter(
        ros: Harness, tmp_path: Path) -> None:
    bench = Bench(ros, {**PURE, 'coolant_temperature.rate_limit': 0.0, 'levels': (
        'own_laws:Raising', 'own_laws:Proportional', 'linear')}, command=program(tmp_path))
    status = bench.status(lambda s: 'out of order' in s.message)
    assert status.level == DiagnosticStatus.WARN
    assert value(status, 'active law') == 'own_laws:Proportional'
    assert 'SystemExit' in status.message
    described, = ros.call(DescribeParameters, '/controller/describe_parameters',
                          DescribeParameters.Request(names=['Proportional.gain'])).descriptors
    assert described.description == 'Proportional gain.'
    steady = bench.measure(STEADY, 2.0).temperature
    before = bench.measure(STEADY + 0.5, 3.0).temperature
    result, = ros.set_parameters('controller', **{'Proportional.gain': 1.0})
    assert result.successful, result.reason
    after = bench.measure(STEADY + 0.5, 4.0).temperature
    assert steady - after == pytest.approx(2.0 * (steady - before), rel=1e-6)
    result, = ros.set_parameters('controller', **{'Proportional.gain': 11.0})
    assert 'must be in [0, 10]' in result.reason
    assert bench.process.stop() == 0


def test_a_law_without_its_method_is_refused_at_the_start(ros: Harness, tmp_path: Path) -> None:
    process = ros.start('controller', {'levels': ('own_laws:Incomplete',)},
                        command=program(tmp_path))
    assert ros.wait_for_end(process) == 1
    assert 'lacks compute' in process.output()
    assert 'Traceback' not in process.output()
