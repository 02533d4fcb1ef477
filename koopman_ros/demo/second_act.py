# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo's second act: the plant drifts, and its controller learns it anew from its record.

Plant, controller and trainer run as three processes in lock-step; none is stopped or restarted.
The disturbance observer is off: it would make up for the drift, and for what a lift lacks.
"""

from dataclasses import dataclass, field, replace
import json
from pathlib import Path
import shutil
import time

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from std_srvs.srv import SetBool, Trigger

from koopman_ros.demo import reactor
from koopman_ros.demo.console import LiveTable, read_options, run_act
from koopman_ros.demo.loop import Operator, running_loop
from koopman_ros.demo.results import plot_retraining, read_run
from koopman_ros.learning import roll_out
from koopman_ros.lifting import LiftedModel, load
from koopman_ros.parameters.trainer import MANUAL
from koopman_ros.plants import (
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    ReactorParameters,
)
from koopman_ros.reports import write_figures
from koopman_ros.resources import model_path
from koopman_ros.testing import HarnessError

STEP = -10.0  # K
FOULING = 0.8  # share of the heat transfer that is left
NOISE = 0.1  # K
_STEP_TIME = 60.0  # s of plant time
_DRIFT_TIME = 360.0
_EXPERIMENT_TIME = 960.0
_EXPERIMENT_MINUTES = 45.0
_AFTER = 960.0  # s of plant time from the reload to the end
_SHOWN = 6000.0  # s of plant time, about as long as it all takes
_TEST_SEED = 7
_TRAINING_TIMEOUT = 300.0  # s
_EXPERIMENT_TIMEOUT = 600.0  # s
# What the fouled reactor bears; see the bounds of the experiment.
_EXPERIMENT = {
    'experiment_on': MANUAL, 'experiment_length': 60.0 * _EXPERIMENT_MINUTES,
    'experiment_longest_hold': 180.0, 'experiment_seed': 1,
    f'{reactor.COOLANT_TEMPERATURE}.experiment_min': 5.5,
    f'{reactor.COOLANT_TEMPERATURE}.experiment_max': 20.5,
    f'{reactor.COOLANT_TEMPERATURE}.safe': 13.0,
}


def run_retraining(output: Path, speed: float) -> dict[str, object]:
    """Run the loop through drift, experiment, training and reload; write and return figures."""
    begin = time.monotonic()
    if output.exists():
        shutil.rmtree(output)
    logs = output / 'logs'
    logs.mkdir(parents=True)
    present = load(model_path(reactor.MODEL))
    setpoint = float(present.states.center[0]) + STEP
    scenario = reactor.scenario(reactor.MODEL, setpoint, step_time=_STEP_TIME, duration=0.0,
                                speed=speed, plant={'temperature.noise': NOISE})
    bags = [output / 'before.mcap', output / 'after.mcap']
    new_model = output / 'retrained.safetensors'
    table = LiveTable('a controller without observer learns its plant anew',
                      scenario.wiring.signals, _SHOWN)
    trainer = {'output': bags[0], 'model_output': new_model, **_EXPERIMENT}
    with table, running_loop(scenario, logs, trainer, table.show) as operator:
        phases = _Actor(operator, table).act(bags[1], new_model)
    history = read_run(scenario.wiring, *bags)
    learned = load(new_model)
    trained = json.loads(new_model.with_suffix('.json').read_text())
    plot_retraining(output / 'retraining.png', history, phases, setpoint, present, learned,
                    reactor.coolant_parameters())
    reload = phases[-1][1]
    result: dict[str, object] = {
        'setpoint_kelvin': setpoint,
        'heat_transfer_left': FOULING,
        'noise_kelvin': NOISE,
        'offset_before_kelvin': history.offset(reactor.TEMPERATURE, setpoint, _EXPERIMENT_TIME),
        'offset_after_kelvin': history.offset(
            reactor.TEMPERATURE, setpoint, reload + _AFTER),
        'heldout_rw': trained['heldout_rw'],
        'heldout_error_kelvin': trained['heldout_error'][reactor.TEMPERATURE],
        'rollout_rmse_kelvin': rollout_rmse(learned),
        'max_coolant_step_before_kelvin': history.largest_step(
            reactor.COOLANT_TEMPERATURE, reload - 120.0, reload - 30.0),
        'max_coolant_step_at_reload_kelvin': history.largest_step(
            reactor.COOLANT_TEMPERATURE, reload - 30.0, reload + 60.0),
        'derivative_method': trained['derivative_method'],
        'wall_seconds': round(time.monotonic() - begin, 3),
    }
    write_figures(output / 'summary.json', result)
    return result


def rollout_rmse(model: LiftedModel) -> float:
    """Predict the fouled reactor over 15 min of fresh steps; return the RMS error in K."""
    usual = ReactorParameters()
    fouled = one_state_reactor(replace(
        usual, heat_transfer_coefficient=FOULING * usual.heat_transfer_coefficient),
        nominal_state=model.states.center)
    design = RandomStepDesign(model.inputs.lower, model.inputs.upper, model.states.lower,
                              model.states.upper, (0.5, 2.0), 1.0 / 60.0, rtol=1e-9)
    truth = random_steps(fouled, design, 15.0, _TEST_SEED)
    predicted = roll_out(model, truth.x[0], truth.u, design.sample_period)
    return float(np.sqrt(np.mean((predicted - truth.x) ** 2)))


class ActError(RuntimeError):
    """A step of the act was refused, or failed."""


@dataclass
class _Actor:
    """The operator's hands."""

    operator: Operator
    table: LiveTable
    phases: list[tuple[str, float]] = field(default_factory=list)  #: name and start in s

    def act(self, second_bag: Path, new_model: Path) -> list[tuple[str, float]]:
        """Do it all; return name and start, in s of plant time, of each phase."""
        operator = self.operator
        self._begin('shipped lift', 'set-point step of -10 K with the shipped lift')
        operator.run_until(_DRIFT_TIME)
        self._set('plant', **{'constants.heat_transfer_coefficient': (
            FOULING * reactor.constant('heat_transfer_coefficient'))})
        self._begin('fouling', 'the cooling jacket fouls: a fifth of its heat transfer is lost')
        # a new bag, so that the plant as it was is not among the data
        self._switch('trainer/record', False)
        self._set('trainer', output=str(second_bag))
        self._switch('trainer/record', True)
        operator.run_until(_EXPERIMENT_TIME)
        self._switch('controller/set_automatic', False)
        self._switch('trainer/experiment', True)
        self._begin('experiment', f'manual mode: random steps for {_EXPERIMENT_MINUTES:.0f} min')
        self._wait_for('experiment', 'finished', _EXPERIMENT_TIMEOUT)
        self._switch('trainer/experiment', False)
        self._switch('controller/set_automatic', True)
        self._begin('training', 'automatic mode again; a lift is learned from the recording')
        _checked('trainer/train', operator.harness.trigger('trainer/train'))
        status = self._wait_for('training', 'the new lift is', _TRAINING_TIMEOUT)
        self.table.announce(status.message)
        if not new_model.exists():
            raise ActError(status.message)
        self._set('controller', model=str(new_model.resolve()))
        self._begin('new lift', 'the controller has taken the new lift over')
        operator.run_until(self.phases[-1][1] + _AFTER)
        return self.phases

    def _begin(self, name: str, text: str) -> None:
        self.phases.append((name, self.operator.seconds))
        self.table.announce(text)

    def _wait_for(self, task: str, words: str, timeout: float) -> DiagnosticStatus:
        """Wait until a task of the trainer says so."""
        def said() -> DiagnosticStatus | None:
            status = self.operator.harness.last_status(f'trainer: {task}')
            if status is not None and status.level == DiagnosticStatus.ERROR:
                raise ActError(f'{task}: {status.message}')
            return status if status is not None and status.message.startswith(words) else None

        status = self.operator.harness.wait_until(said, f'the {task} did not end', timeout)
        assert status is not None
        return status

    def _switch(self, service: str, on: bool) -> None:
        _checked(service, self.operator.harness.set_bool(service, on))

    def _set(self, node: str, **values: object) -> None:
        for result in self.operator.harness.set_parameters(node, **values):
            if not result.successful:
                raise ActError(f'{node}: {result.reason}')


def _checked(service: str, response: SetBool.Response | Trigger.Response) -> None:
    if not response.success:
        raise ActError(f'{service}: {response.message}')


def main(args: list[str] | None = None) -> int:
    """Run the second act from the command line."""
    options = read_options(args, __doc__, 'out/demo-retrain', 120.0)
    return run_act(run_retraining, options, (ActError, HarnessError, OSError, ValueError),
                   'retraining.png, before.mcap, after.mcap, '
                   'retrained.safetensors with its report, and summary.json')
