# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The reactor at its saddle over ROS: recorded under a PI law, learned from its temperature, held.

Plant, controller and trainer run as three processes in lock-step; model, filter and laws know the
temperature alone. Afterwards the same laws and filter, with the plant's own equations in the place
of the model, go the same course with the same noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import shutil
import sys
import time

# where it is missing, the demo ends before it has run and not after
import matplotlib.figure  # noqa: F401
import numpy as np
from sensor_msgs.msg import JointState

from koopman_ros.control import Controller, Initialisation, SetpointRequest, Tuning
from koopman_ros.core.arrays import Array
from koopman_ros.core.plots import draw_limits, drawing, DRAWN_RANGE, LIMIT, write_figures
from koopman_ros.core.units import NANOSECONDS, SECONDS_PER_MINUTE, to_celsius, ZERO_CELSIUS
from koopman_ros.demo.console import LiveTable, read_options, run_demo
from koopman_ros.demo.loop import FIRST_STAMP_NS, Operator, Row, running_loop, Scenario
from koopman_ros.demo.reactor import constant
from koopman_ros.demo.results import draw_phases
from koopman_ros.evaluation import at, run_loop
from koopman_ros.evaluation.loop import after_a_second, LoopRun
from koopman_ros.model import Coordinates, LiftedModel, linearised_model, load, Provenance, save
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.trainer import SETPOINT
from koopman_ros.plants import ControlAffineSystem, Process, sensor_noise
from koopman_ros.ros.time_conversion import stamp_nanoseconds
from koopman_ros.ros.topics import CONTROLLER_INTERNALS, LOOP_QOS
from studies.robustness.loop import on_plant
from studies.saddle import controller, cost, FOULING, NOISE, reactor, UA, WANDER, WIDE
from studies.saddle import truth as true_model
from studies.unstable import MARGIN, SADDLE_TEMPERATURE

SEEDS = 5
LIMIT_TEMPERATURE = 356.0  # K
# where the data end, the PI law goes on
LAWS = ('mpc', 'sdre', 'pi')
PI_GAIN, PI_TIME, RAMP = 8.0, 120.0, 0.1  # K/K, s and K/s
SPREAD = 10.0  # K of the set-points about the saddle, while it is recorded
MINUTES = 60.0  # of that
_SETTLED = 1200.0  # s of plant time, when the PI law has brought the reactor to the saddle
_LEAD = 120.0  # s from the take-over to the first set-point
# Set-points in K by the time in s from the take-over; then the jacket fouls.
COURSE, FOULED, END = {0.0: SADDLE_TEMPERATURE, _LEAD: 355.0, 560.0: 345.0}, 1060.0, 1660.0
_ANYWHERE = 10.0  # half-ranges of a trained range
_LATE = 120  # samples over which an offset is averaged
_TIMEOUT = 900.0  # s for an experiment or a training
_PLANT = 'two_state'
# What an operator has at hand: names, units and ranges of two signals, in K.
_SIGNALS = {'temperature': (320.0, 375.0),
            'coolant_temperature': (float(WIDE.lower[0]), float(WIDE.upper[0]))}


@dataclass(frozen=True)
class _Run:
    """A run, a row for each sample, with the true states."""

    seconds: Array  #: (N,) since the first measurement
    measured: Array  #: (N,) in K
    setpoints: Array  #: (N,), NaN before the first
    commands: Array  #: (N,)
    states: Array  #: (N, 2) in mol/L and K
    fouled: int  #: first sample at which the jacket is fouled
    #: (N,) the concentration that explains the heat that the model expects, NaN without one
    concentration: Array

    @property
    def noise(self) -> Array:
        """Errors (N,) of the sensor."""
        return self.measured - self.states[:, 1]


def run_seed(folder: Path, seed: int, speed: float) -> dict[str, float | bool]:
    """Run it all once; return its figures, and draw it."""
    if folder.exists():
        shutil.rmtree(folder)
    logs = folder / 'logs'
    logs.mkdir(parents=True)
    signals, learned = folder / 'signals.safetensors', folder / 'learned.safetensors'
    save(names_and_ranges(), signals)
    bags = [folder / 'start_up.mcap', folder / 'recorded.mcap']
    scenario = Scenario({'temperature': SADDLE_TEMPERATURE}, _PLANT, step_time=0.0, duration=0.0,
                        speed=speed, plant={'temperature.measurement_noise': NOISE, 'seed': seed},
                        controller=_controller_parameters(signals))
    rows: list[Row] = []
    estimates: dict[int, JointState] = {}
    table = LiveTable('the reactor at its saddle is learned from its temperature alone',
                      scenario.wiring.signals,
                      _SETTLED + SECONDS_PER_MINUTE * MINUTES + END)

    def on_row(row: Row) -> None:
        rows.append(row)
        table.show(row)

    with running_loop(scenario, logs, _trainer_parameters(bags[0], learned, seed),
                      on_row) as operator:
        def on_estimate(message: JointState) -> None:
            estimates[stamp_nanoseconds(message.header.stamp)] = message

        operator.harness.node.create_subscription(
            JointState, CONTROLLER_INTERNALS, on_estimate, LOOP_QOS)
        phases = _operate(operator, bags[1], learned)
    model = load(learned)
    run = _run_of(rows, estimates, model, seed, phases)
    figures = _figures(run, model, dict(phases)['lift'])
    draw(folder / 'saddle.png', run, phases, model, seed)
    return figures


def names_and_ranges() -> LiftedModel:
    """Return a model that knows names, units and ranges alone."""
    states, inputs = (Coordinates.spanning((name,), ('K',), np.array([low]), np.array([high]))
                      for name, (low, high) in _SIGNALS.items())
    return linearised_model(np.zeros((1, 1)), np.zeros((1, 1)), states, inputs, 'min',
                            Provenance('signals alone'))


def _controller_parameters(model: Path) -> dict[str, object]:
    return {
        'system': 'none', 'model': model, 'fallback_order': ['pi'], 'pi.temperature.gain': PI_GAIN,
        'pi.temperature.integral_time': PI_TIME, 'temperature.setpoint_ramp': RAMP,
        'temperature.measurement_noise': NOISE,
        'mpc.temperature.max': to_celsius(LIMIT_TEMPERATURE),
        'coolant_temperature.min': to_celsius(float(WIDE.lower[0])),
        'coolant_temperature.max': to_celsius(float(WIDE.upper[0])),
        'coolant_temperature.rate_limit': float(WIDE.rate[0]),
        'coolant_temperature.disturbance_noise': WANDER * SECONDS_PER_MINUTE ** 0.5,
        'coolant_temperature.safe_value': 5.0, 'temperature.weight': 1.0,
        'coolant_temperature.weight': 1.0, 'learned_model_margin': MARGIN,
        # the PI law asks nothing of a model, wherever the plant is
        'linear_model_margin': _ANYWHERE,
        # names and ranges have no time constant that would say it
        'model_check_length': 100.0}


def _trainer_parameters(bag: Path, learned: Path, seed: int) -> dict[str, object]:
    low, high = SADDLE_TEMPERATURE - SPREAD, SADDLE_TEMPERATURE + SPREAD
    return {
        'system': 'none', 'states_measured': ['temperature [K]'],
        'inputs_commanded': ['coolant_temperature [K]'], 'output': bag, 'model_output': learned,
        'unmeasured_states': 1, 'lifted_dimension': 5, 'restarts': 1,
        'experiment_signal': SETPOINT, 'experiment_length': SECONDS_PER_MINUTE * MINUTES,
        'experiment_min_hold_time': 30.0, 'experiment_max_hold_time': 90.0,
        'experiment_seed': seed, 'temperature.setpoint_min': to_celsius(low),
        'temperature.setpoint_max': to_celsius(high),
        # where the PI law could not bring it back
        'temperature.experiment_min': to_celsius(low - 10.0),
        'temperature.experiment_max': to_celsius(high + 10.0)}


def _operate(operator: Operator, bag: Path, learned: Path) -> list[tuple[str, float]]:
    """Run all phases; return name and start, in s of plant time, of each phase."""
    operator.begin('start-up', 'a PI law brings the reactor to its saddle and holds it there')
    operator.run_until(_SETTLED)
    operator.record_again(bag)
    operator.leave_setpoints()
    operator.switch('trainer/experiment', True)
    operator.begin('experiment', f'set-points are stepped for {MINUTES:.0f} min')
    operator.wait_for('experiment', 'finished', _TIMEOUT)
    operator.switch('trainer/experiment', False)
    operator.begin('training', 'a lift is learned from temperature and coolant')
    operator.train(learned, _TIMEOUT)
    operator.set('controller', model=str(learned.resolve()), fallback_order=list(LAWS),
                 **{'temperature.setpoint_ramp': 0.0})
    operator.begin('lift', 'the lift has taken over')
    begin = operator.seconds
    for sent, when, value in _requests():
        operator.run_until(begin + sent)
        operator.request_setpoints({'temperature': value}, begin + when)
    operator.run_until(begin + FOULED)
    operator.set('plant', **{'constants.heat_transfer_coefficient': (
        FOULING['heat_transfer_coefficient'] / UA * constant('heat_transfer_coefficient'))})
    operator.begin('fouling', 'the jacket fouls: UA -15 %')
    operator.run_until(begin + END)
    return operator.phases


def _requests() -> Iterator[tuple[float, float, float]]:
    """Yield when each set-point is sent, from when on it holds, both in s, and its value in K."""
    sent = 0.0
    for when, value in COURSE.items():
        yield sent, when, value
        # a later one in advance would replace it
        sent = when + 1.0


def _run_of(rows: list[Row], estimates: Mapping[int, JointState], model: LiftedModel, seed: int,
            phases: list[tuple[str, float]]) -> _Run:
    """Return a run; the plant publishes the concentration, to which no node under test listens."""
    seconds = np.array([row.seconds for row in rows])
    setpoints = np.array([row.setpoints.get('temperature', np.nan) for row in rows])
    commands = np.array([row.commanded['coolant_temperature'] for row in rows])
    C, measured = (np.array([row.measured[name] for row in rows])
                   for name in ('concentration', 'temperature'))
    found = np.full(len(rows), np.nan)
    for k, second in enumerate(seconds):
        message = estimates.get(FIRST_STAMP_NS + round(second * NANOSECONDS))
        if message is not None:
            found[k] = _concentration(model, dict(zip(message.name, message.position,
                                                      strict=True)))
    return _Run(seconds, measured, setpoints, commands,
                np.column_stack([C, without_noise(seconds, measured, seed)]),
                int(np.searchsorted(seconds, dict(phases)['fouling'])), found)


def without_noise(seconds: Array, measured: Array, seed: int) -> Array:
    """Return the true temperatures (N,): the seed gives the noise of each sample."""
    place = _usual().state_names.index('temperature')
    return measured - [sensor_noise(NOISE, seed, round(second), place) for second in seconds]


def _usual() -> ControlAffineSystem:
    """Return the reactor as the plant node starts it, at rest."""
    table = PlantTable({'system': _PLANT})
    return table.system(table.snapshot({}))


def _concentration(model: LiftedModel, said: Mapping[str, float]) -> float:
    """
    Return the concentration at which the reaction gives the heat that a model expects, in mol/L.

    A state that was never measured has coordinates of its own; the temperature's rate has not.
    """
    hidden = next((value for name, value in said.items()
                   if name.startswith('estimated_hidden_1')), None)
    if hidden is None:
        return np.nan
    T = said['estimated_temperature [degC]'] + ZERO_CELSIUS
    u = model.inputs.center
    xi = model.states.to_deviation(np.array([T, hidden]))
    expected = float(model.drift(xi)[0] * model.states.scale[0]) * (
        SECONDS_PER_MINUTE / model.seconds_per_time_unit)
    none, one = (float(_usual().derivative(np.array([c, T]), u)[1]) for c in (0.0, 1.0))
    return (expected - none) / (one - none)


def _laws(model: LiftedModel, laws: tuple[str, ...], *, informed: bool = False) -> Controller:
    """Return a controller of temperature and concentration as the node's was, of another model."""
    # not when the harness starts, which does not need it
    from koopman_ros.control.mpc import MPCParameters

    return controller(model, laws, WIDE, informed=informed, plugins={
        'mpc': MPCParameters(upper=np.array([np.inf, LIMIT_TEMPERATURE]))})


def _pi() -> Controller:
    """Return the PI law as the node started with it."""
    from koopman_ros.control.laws.pi import PIParameters

    model = names_and_ranges()
    return Controller(model, Tuning.for_model(
        model, state_weight=np.ones(1), input_weight=np.ones(1), limits=WIDE,
        controlled=('temperature',), bumpless_transfer_time=0.0, setpoint_ramp=np.array([RAMP]),
        plugins={'pi': PIParameters(np.full(1, PI_GAIN), np.full(1, PI_TIME))},
        measurement_noise=np.full(1, NOISE), fallback_order=('pi',),
        disturbance_noise=np.full(1, WANDER * np.sqrt(SECONDS_PER_MINUTE)),
        learned_model_margin=MARGIN, linear_model_margin=MARGIN))


def _figures(run: _Run, model: LiftedModel, begin: float) -> dict[str, float | bool]:
    """Compare the run from the take-over on with others from there, with the same noise."""
    first = int(np.searchsorted(run.seconds, begin))
    noise, x0 = run.noise[first:], run.states[first]
    u0, fouled = run.commands[first - 1:first], float(run.fouled - first)
    plant = Process(_usual(), 0, x0, u0)

    def other(one: Controller) -> LoopRun:
        n_y = len(one.measured.names)
        return run_loop(
            one, plant, [
                at(0.0, Initialisation(u0)), at(fouled, on_plant(system=reactor(FOULING))),
                *(at(sent, SetpointRequest(after_a_second(round(when * NANOSECONDS)),
                                           np.array([value])))
                  for sent, when, value in _requests())],
            duration=float(len(noise) - 1), C=np.eye(2)[-n_y:],
            sensor=lambda y, seconds: y + np.array([0.0, noise[round(seconds)]])[-n_y:])

    T, u = run.states[first:, 1], run.commands[first:]
    own = _cost(T, u, fouled)
    costs = {}
    for name, one in (('true_model', _laws(true_model(), LAWS[:2])),
                      ('full_information', _laws(true_model(), LAWS[:2], informed=True)),
                      ('pi', _pi())):
        loop = other(one)
        costs[name] = _cost(loop.states[:, 1], loop.commands[:, 0], fouled)
    # a law that plans moves before a set-point that it knows
    ahead = _laws(true_model(), LAWS[:2]).best.law.horizon(1.0)
    ends = [*(when - ahead for when in list(COURSE)[2:]), fouled, len(T)]
    offsets = [abs(float(np.mean(T[int(end) - _LATE:int(end)])) - value)
               for end, value in zip(ends, [355.0, 345.0, 345.0], strict=True)]
    counted = slice(first + int(_LEAD), run.fouled)
    error = (run.concentration - run.states[:, 0])[counted]
    return {
        'final_error_kelvin': offsets[-1],
        'largest_offset_kelvin': max(offsets),
        'cost_over_true_model': own / costs['true_model'],
        'cost_over_full_information': own / costs['full_information'],
        'pi_cost_ratio': costs['pi'] / own,
        'max_limit_violation_kelvin': max(0.0, float(np.max(T)) - LIMIT_TEMPERATURE),
        'concentration_rmse': float(np.sqrt(np.nanmean(error ** 2))),
        **{f'largest_coolant_step_{name}_kelvin': float(np.max(np.abs(np.diff(
            run.commands[part])))) for name, part in (
                ('before', slice(first - int(_LEAD), first)),
                ('at_take_over', slice(first - 2, first + int(_LEAD))))},
        'largest_distance_at_take_over_kelvin': float(np.max(np.abs(
            T[:int(_LEAD)] - SADDLE_TEMPERATURE))),
        'diverged': bool(np.max(np.abs(T - SADDLE_TEMPERATURE)) > 25.0)}


def _cost(T: Array, u: Array, fouled: float) -> float:
    """Return the cost of the set-points after the first, until it fouls."""
    edges = [*map(int, COURSE), int(fouled)]
    parts = list(zip(edges, edges[1:], COURSE.values(), strict=False))
    return sum(cost(T[begin:end], u[begin:end], value, _usual(), 1.0)
               for begin, end, value in parts[1:])


def draw(path: Path, run: _Run, phases: list[tuple[str, float]], model: LiftedModel, seed: int
         ) -> None:
    """Draw temperature, coolant and concentration over plant time, phase by phase."""
    minutes = run.seconds / SECONDS_PER_MINUTE
    with drawing(path, 3, 1, size=(11.0, 9.0), sharex=True, height_ratios=(3, 2, 2)) as (
            _, (upper, middle, lower)):
        upper.axhspan(*(to_celsius(float(b[0])) for b in (model.states.lower,
                                                          model.states.upper)),
                      label='training range', **DRAWN_RANGE)
        upper.plot(minutes, run.measured - ZERO_CELSIUS, color='tab:green', linewidth=0.8,
                   label='measured')
        upper.plot(minutes, run.setpoints - ZERO_CELSIUS, 'k--', linewidth=1.0,
                   label='set-point')
        upper.axhline(to_celsius(LIMIT_TEMPERATURE), **{**LIMIT, 'linestyle': '-.'},
                      label='limit of the law')
        upper.set(ylabel='reactor temperature [°C]', title='A PI law holds the unstable reactor; '
                  f'a lift is learned from its temperature alone and takes over (seed {seed})')
        draw_phases((upper, middle, lower), phases)
        upper.legend(loc='lower right', fontsize=8, ncols=2)
        draw_limits(middle, [to_celsius(float(b[0])) for b in (WIDE.lower, WIDE.upper)],
                    'coolant limits')
        middle.step(minutes, run.commands - ZERO_CELSIUS, where='post', color='tab:blue',
                    linewidth=0.8, label='commanded')
        middle.set_ylabel('coolant [°C]')
        middle.legend(loc='upper right', fontsize=8)
        lower.plot(minutes, run.states[:, 0], color='k', linewidth=1.0,
                   label='that of the plant, not measured')
        lower.plot(minutes, run.concentration, color='tab:orange', linewidth=0.8,
                   label='that which explains the heat that the lift expects')
        lower.set(ylabel='concentration [mol/L]', xlabel='plant time [min]',
                  xlim=(0.0, float(minutes[-1])))
        lower.legend(loc='upper center', fontsize=8)


def run_saddle(output: Path, speed: float, seeds: int = SEEDS) -> dict[str, object]:
    """Run it from several seeds; write and return the figures."""
    begin = time.monotonic()
    output.mkdir(parents=True, exist_ok=True)
    (output / 'summary.json').unlink(missing_ok=True)
    runs = [run_seed(output / f'seed_{seed}', seed, speed) for seed in range(seeds)]
    result: dict[str, object] = {
        'seeds': list(range(seeds)), 'noise_kelvin': NOISE,
        'heat_transfer_left': FOULING['heat_transfer_coefficient'] / UA,
        **{name: [run[name] for run in runs] for name in runs[0]},
        'wall_seconds': round(time.monotonic() - begin, 3)}
    write_figures(output / 'summary.json', result)
    return result


def main(args: list[str] | None = None) -> int:
    """Run it from the command line."""
    options = read_options(args, __doc__, 'out/demo-saddle', 200.0, seeds=SEEDS)
    return run_demo(partial(run_saddle, seeds=options.seeds), options,
                    'summary.json, and for each seed saddle.png, two bags and '
                    'learned.safetensors with its report')


if __name__ == '__main__':
    sys.exit(main())
