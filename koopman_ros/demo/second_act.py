# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo's second act: the plant drifts, and its controller learns it anew from its record.

Plant, controller and trainer run as three processes in lock-step; none is stopped or restarted.
The disturbance observer is off: it would make up for the drift, and for what a lift lacks.
"""

from dataclasses import replace
import json
from pathlib import Path
import shutil
import time

import numpy as np

from koopman_ros.demo import reactor
from koopman_ros.demo.console import LiveTable, read_options, run_act
from koopman_ros.demo.hands import ActError, Hands
from koopman_ros.demo.loop import running_loop
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
        phases = _act(Hands(operator, table), bags[1], new_model)
    history = read_run(scenario.wiring, *bags)
    learned = load(new_model)
    trained = json.loads(new_model.with_suffix('.json').read_text())
    plot_retraining(output / 'retraining.png', history, phases, setpoint, present, learned,
                    reactor.coolant_limits())
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


def _act(hands: Hands, second_bag: Path, new_model: Path) -> list[tuple[str, float]]:
    """Do it all; return name and start, in s of plant time, of each phase."""
    operator = hands.operator
    hands.begin('shipped lift', 'set-point step of -10 K with the shipped lift')
    operator.run_until(_DRIFT_TIME)
    hands.set('plant', **{'constants.heat_transfer_coefficient': (
        FOULING * reactor.constant('heat_transfer_coefficient'))})
    hands.begin('fouling', 'the cooling jacket fouls: a fifth of its heat transfer is lost')
    # a new bag, so that the plant as it was is not among the data
    hands.record_anew(second_bag)
    operator.run_until(_EXPERIMENT_TIME)
    hands.switch('controller/set_automatic', False)
    hands.switch('trainer/experiment', True)
    hands.begin('experiment', f'manual mode: random steps for {_EXPERIMENT_MINUTES:.0f} min')
    hands.wait_for('experiment', 'finished', _EXPERIMENT_TIMEOUT)
    hands.switch('trainer/experiment', False)
    hands.switch('controller/set_automatic', True)
    hands.begin('training', 'automatic mode again; a lift is learned from the recording')
    hands.train(new_model, _TRAINING_TIMEOUT)
    hands.set('controller', model=str(new_model.resolve()))
    hands.begin('new lift', 'the controller has taken the new lift over')
    operator.run_until(hands.phases[-1][1] + _AFTER)
    return hands.phases


def main(args: list[str] | None = None) -> int:
    """Run the second act from the command line."""
    options = read_options(args, __doc__, 'out/demo-retrain', 120.0)
    return run_act(run_retraining, options, (ActError, HarnessError, OSError, ValueError),
                   'retraining.png, before.mcap, after.mcap, '
                   'retrained.safetensors with its report, and summary.json')
