# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The demo of retraining: the plant drifts, and its controller is retrained from a new record.

Plant, controller and trainer run as three processes in lock-step; none is stopped or restarted.
The disturbance observer is off: it would remove the offset that shows an outdated model.
"""

from dataclasses import replace
import json
from pathlib import Path
import shutil
import time

import numpy as np

from koopman_ros.core.paths import model_path
from koopman_ros.core.plots import draw_limits, drawing, LIMIT, write_figures
from koopman_ros.core.units import to_celsius, ZERO_CELSIUS
from koopman_ros.demo import reactor
from koopman_ros.demo.console import LiveTable, read_options, run_demo
from koopman_ros.demo.loop import Operator, running_loop
from koopman_ros.demo.results import DemoRun, draw_phases, read_run
from koopman_ros.model import LiftedModel, load
from koopman_ros.parameters.trainer import MANUAL
from koopman_ros.plants import one_state_reactor, random_steps, RandomStepDesign, ReactorParameters

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
# Limits of the fouled reactor; see the bounds of the experiment.
_EXPERIMENT = {
    'experiment_signal': MANUAL, 'experiment_length': 60.0 * _EXPERIMENT_MINUTES,
    'experiment_max_hold_time': 180.0, 'experiment_seed': 1,
    f'{reactor.COOLANT_TEMPERATURE}.experiment_min': 5.5,
    f'{reactor.COOLANT_TEMPERATURE}.experiment_max': 20.5,
    f'{reactor.COOLANT_TEMPERATURE}.safe_value': 13.0,
}


def run_retraining(output: Path, speed: float) -> dict[str, object]:
    """Run the loop through drift, experiment, training and reload; write and return figures."""
    begin = time.monotonic()
    if output.exists():
        shutil.rmtree(output)
    present = load(model_path(reactor.MODEL))
    setpoint = float(present.states.center[0]) + STEP
    scenario = reactor.scenario(reactor.MODEL, setpoint, step_time=_STEP_TIME, duration=0.0,
                                speed=speed, plant={'temperature.measurement_noise': NOISE})
    bags = [output / 'before.mcap', output / 'after.mcap']
    new_model = output / 'retrained.safetensors'
    table = LiveTable('retraining with the disturbance observer off',
                      scenario.wiring.signals, _SHOWN)
    trainer = {'output': bags[0], 'model_output': new_model, **_EXPERIMENT}
    with running_loop(scenario, output / 'logs', trainer, table.show) as operator:
        phases = _operate(operator, bags[1], new_model)
    history = read_run(scenario.wiring, *bags)
    learned = load(new_model)
    trained = json.loads(new_model.with_suffix('.json').read_text())
    _draw(output / 'retraining.png', history, phases, setpoint, {
        'shipped lift': (present, ':'), 'new lift': (learned, '-.')})
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
    predicted = model.predict(truth.x[0], truth.u, design.sample_period)
    return float(np.sqrt(np.mean((predicted - truth.x) ** 2)))


def _operate(operator: Operator, second_bag: Path, new_model: Path) -> list[tuple[str, float]]:
    """Run all phases; return name and start, in s of plant time, of each phase."""
    operator.begin('shipped lift', 'set-point step of -10 K with the bundled model')
    operator.run_until(_DRIFT_TIME)
    operator.set('plant', **{'constants.heat_transfer_coefficient': (
        FOULING * reactor.constant('heat_transfer_coefficient'))})
    operator.begin('fouling', 'the cooling jacket fouls: heat transfer falls by a fifth')
    # a new bag, so that the plant as it was is not among the data
    operator.record_again(second_bag)
    operator.run_until(_EXPERIMENT_TIME)
    operator.switch('controller/set_automatic', False)
    operator.switch('trainer/experiment', True)
    operator.begin('experiment', f'manual mode: random steps for {_EXPERIMENT_MINUTES:.0f} min')
    operator.wait_for('experiment', 'finished', _EXPERIMENT_TIMEOUT)
    operator.switch('trainer/experiment', False)
    operator.switch('controller/set_automatic', True)
    operator.begin('training', 'automatic mode; training a model on the recording')
    operator.train(new_model, _TRAINING_TIMEOUT)
    operator.set('controller', model=str(new_model.resolve()))
    operator.begin('new lift', 'the new model is active')
    operator.run_until(operator.phases[-1][1] + _AFTER)
    return operator.phases


def _draw(path: Path, history: DemoRun, phases: list[tuple[str, float]], setpoint: float,
          models: dict[str, tuple[LiftedModel, str]]) -> None:
    """Draw temperature, coolant and error over plant time, phase by phase."""
    minutes = history.seconds / 60.0
    temperature = history.measured[reactor.TEMPERATURE]
    smooth = np.convolve(temperature - setpoint, np.ones(60) / 60.0, mode='valid')
    with drawing(path, 3, 1, size=(11.0, 9.0), sharex=True,
                 height_ratios=(3, 2, 2)) as (_, (upper, middle, lower)):
        upper.plot(minutes, temperature - ZERO_CELSIUS, color='tab:green', linewidth=1.0,
                   label='measured')
        upper.axhline(to_celsius(setpoint), color='k', linestyle='--', linewidth=1.0,
                      label='set-point')
        for name, (model, style) in models.items():
            for i, bound in enumerate((model.states.lower[0], model.states.upper[0])):
                upper.axhline(to_celsius(float(bound)), **{**LIMIT, 'linestyle': style},
                              label=f'training range of the {name}' if i == 0 else None)
        draw_phases((upper, middle, lower), phases)
        upper.set(ylabel='reactor temperature [°C]', title=(
            'The plant changes, and the model is retrained on recorded data (disturbance observer '
            'off)'))
        upper.legend(loc='lower right', ncols=2, fontsize=8)
        draw_limits(middle, reactor.coolant_limits(), 'coolant limits')
        middle.step(history.command_seconds / 60.0,
                    history.commanded[reactor.COOLANT_TEMPERATURE] - ZERO_CELSIUS, where='post',
                    color='tab:blue', linewidth=1.0, label='commanded')
        middle.set_ylabel('coolant [°C]')
        middle.legend(loc='upper right', fontsize=8)
        lower.semilogy(minutes[30:30 + len(smooth)], np.maximum(np.abs(smooth), 1e-4),
                       color='tab:red', linewidth=1.0, label='mean over one minute')
        lower.set(ylabel='absolute error [K]', xlabel='plant time [min]',
                  xlim=(0.0, float(minutes[-1])))
        lower.legend(loc='lower left', fontsize=8)


def main(args: list[str] | None = None) -> int:
    """Run the demo from the command line."""
    options = read_options(args, __doc__, 'out/demo-retrain', 120.0)
    return run_demo(run_retraining, options, 'retraining.png, before.mcap, after.mcap, '
                    'retrained.safetensors with its report, and summary.json')
