# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The table of cases: the fault, and the bounds that the loop must keep to."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
import itertools
import math
import signal
from typing import Any

from koopman_ros.core.status import StatusCode
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.demo import reactor
from studies.faults import interceptor, operators, processes, silence
from studies.faults.case import FaultCase
from studies.faults.interceptor import delayed, frozen, lost, noise, Packet, stamped, twice, value
from studies.faults.operators import altered, changed_for_good, Maker, REQUESTS, scaled
from studies.faults.plants import (
    FaultPlant,
    HEATED_LINE,
    LOCKSTEP,
    PATIENT,
    PENDULUM,
    QUADRUPLE_TANK,
    REACTOR,
    SADDLE,
    TWO_TANKS,
)

_COOLANT = reactor.COOLANT_TEMPERATURE
_BUMP, _TANK_BUMP = 0.01, 0.05  # K, V, where nothing calls for more
_SPIKE = 0.05  # m, more than any of the tanks can rise in a sample
_BY_CLOCK = {'use_sim_time': True}
_FAST = {'lockstep': True, 'speed': 30.0}
_SILENT = {'lockstep': True, 'speed': 60.0}
# s of plant time between two looks of the controller, which are 0.1 s of wall time apart
_LOOK = 8.0
_NEVER_IN_TIME = {'fallback_order': ('mpc', 'sdre', 'linear'), 'mpc.time_limit': 1e-6}
_SHORT_HOLD = {**_NEVER_IN_TIME, 'hold_timeout': 1.0, 'recovery_time': 1.0}
# Largest distance from the set-point after a few seconds of the safe inputs.
_NEAR = {REACTOR.name: 10.0, TWO_TANKS.name: 0.08}


def _on(on: FaultPlant, group: str, name: str, does: str, play: Callable[..., None], **details: Any
        ) -> FaultCase:
    """Return a case on a plant, at its set-points and times; its name begins with the plant's."""
    return FaultCase(group, f'{on.name}-{name}', does, play, **{
        'on': on, 'setpoint': on.setpoint, 'settle': on.settle, 'afterwards': on.afterwards,
        'recovery': on.recovery, 'band': on.band, **details})


def _altered(case: Callable[..., FaultCase], group: str, name: str, does: str, make: Maker,
             seconds: float, code: StatusCode | None = None, *, step: tuple[float, ...] = (),
             what: str = 'measurements', wait: float = 0.0, **details: Any) -> FaultCase:
    """
    Return a case whose messages are altered for some seconds.

    :param case: makes it, on a plant.
    :param step: set-point that is requested before, if any; `wait` s before.
    """
    return case(group, name, f'{does}, {"while the set-point steps, " * bool(step)}{seconds:g} s',
                partial(altered, make=make, seconds=seconds, setpoint=step, what=what, wait=wait),
                between=True, code=code, **details)


# Alterations.

def _shows(shown: float) -> Maker:
    return lambda: value(lambda *_: shown)


def _shifted(shift: Callable[[float], float]) -> Maker:
    """Make a sensor with this error after these seconds."""
    return lambda: value(lambda seconds, measured: measured + shift(seconds))


def _stamps(seconds: float) -> Maker:
    return lambda: stamped(lambda stamp_ns: stamp_ns + round(seconds * NANOSECONDS))


def _jittered(stamp_ns: int) -> int:
    """Return a stamp that is up to 0.4 s early or late, the same in every run."""
    return stamp_ns + (stamp_ns // NANOSECONDS * 7919 % 800 - 400) * 1_000_000


def _twins(offset: float, first: bool = False) -> Maker:
    """Deliver each packet twice, once with other values."""
    def alter(packet: Packet) -> list[Packet]:
        other = packet._replace(values={
            name: shown + offset for name, shown in packet.values.items()})
        return [other, packet] if first else [packet, other]

    return lambda: alter


def _twice() -> interceptor.Alteration:
    return twice


# The reactor: one temperature, one coolant.

_sensor = partial(_altered, FaultCase, 'sensor')
_in_a_step = partial(_altered, FaultCase, step=REACTOR.other, largest_step=2.0)
_clock = partial(_in_a_step, 'clocks')
_MESSAGES = (
    _sensor('nan-short', 'NaN', _shows(math.nan), 5.0, StatusCode.NOT_FINITE),
    _sensor('nan-long', 'NaN', _shows(math.nan), 180.0, StatusCode.NOT_FINITE),
    _sensor('infinity', '+inf', _shows(math.inf), 10.0, StatusCode.NOT_FINITE),
    _sensor('minus-infinity', '-inf', _shows(-math.inf), 10.0, StatusCode.NOT_FINITE),
    _sensor('huge', '1e300 degC', _shows(1e300), 10.0, StatusCode.NOT_FINITE),
    _sensor('minus-zero', '-0.0 degC', _shows(-0.0), 10.0, StatusCode.JUMPED),
    _sensor('below-absolute-zero', '-300 degC', _shows(-300.0), 10.0, StatusCode.NOT_FINITE),
    _sensor('out-of-range', '200 degC', _shows(200.0), 20.0, StatusCode.OUTSIDE_SENSOR),
    _sensor('railed', 'at the upper end of its range, 150 degC', _shows(150.0), 60.0,
            StatusCode.JUMPED),
    _sensor('spike-short', '+30 K in one sample', _shifted(lambda _: 30.0), 1.0,
            StatusCode.JUMPED),
    _sensor('spike-long', '+15 K', _shifted(lambda _: 15.0), 20.0, StatusCode.JUMPED),
    _sensor('spikes', 'a spike of +20 K in every seventh sample',
            _shifted(lambda seconds: 20.0 * (seconds % 7.0 == 0.0)), 140.0, StatusCode.JUMPED),
    _sensor('frozen-at-rest', 'bit-identical values', frozen, 120.0),
    _sensor('frozen-in-a-step', 'bit-identical values', frozen, 90.0, StatusCode.FROZEN,
            step=(42.0,), wait=10.0),
    _sensor('drift', 'drifts by 1 K/min', _shifted(lambda seconds: seconds / 60.0), 180.0),
    FaultCase('sensor', 'bias', 'wrong by +2 K, 300 s and more', operators.biased, True,
              recovery=360.0, afterwards=420.0),
    _sensor('noise-burst', 'noise of 1 K', lambda: noise(1.0), 60.0),
    _sensor('noise-wild', 'noise of 10 K', lambda: noise(10.0), 60.0, StatusCode.JUMPED),
    _sensor('quantised', 'in steps of 0.5 K, the set-point between two of them',
            lambda: value(lambda _, measured: round(2.0 * measured) / 2.0), 300.0,
            setpoint=(45.8,)),
    _sensor('dropout-short', 'no measurement', lost, 5.0),
    _sensor('dropout-long', 'no measurement', lost, 150.0, StatusCode.NO_MEASUREMENT,
            plant=_SILENT, controller=_BY_CLOCK, largest_step=_LOOK,
            says=('^controller: control: no measurement',)),
    *(_in_a_step('messages', f'{what}-{name}', f'{what}: {does}', make, 120.0, what=what,
                 largest_step=largest_step)
      for what, largest_step in (('measurements', 2.0), ('commands', 1.0))
      for name, does, make in (
          ('lost', '30 % lost', lambda: lost(0.3)),
          ('mostly-lost', '80 % lost', lambda: lost(0.8)),
          ('doubled', 'each comes twice', _twice),
          ('swapped', 'each two in the wrong order', interceptor.swapped),
          ('late', 'each 3 s late', lambda: delayed(3)))),
    _clock('clock-forward', 'stamps jump an hour ahead, and then back', _stamps(3600), 120.0),
    _clock('clock-back', 'stamps jump an hour back, and then ahead', _stamps(-3600), 120.0,
           plant={**LOCKSTEP, 'start_time': 10_000.0}),
    _clock('clock-far', 'stamps jump 60 years ahead, and then back', _stamps(1_900_000_000), 60.0),
    _clock('clock-zero', 'stamps are zero', lambda: stamped(lambda _: 0), 30.0),
    _clock('clock-stopped', 'stamps do not advance', partial(frozen, 'stamp_ns'), 30.0,
           says=('^controller: control: .*does not advance',)),
    _clock('clock-jitter', 'stamps are up to 0.4 s wrong', lambda: stamped(_jittered), 120.0),
    _clock('clock-twins', 'two measurements with each stamp', _twins(0.01), 60.0),
    FaultCase('clocks', 'no-clock', 'use_sim_time is set, but /clock has no publisher',
              operators.without_clock, plant={**LOCKSTEP, 'publish_clock': False},
              controller=_BY_CLOCK, says=(operators.NO_CLOCK,)))

_process, _neighbour = partial(FaultCase, 'processes'), partial(FaultCase, 'neighbours')
_PROCESSES = (
    _process('plant-restart', 'the plant is ended and started again, 5 K too warm and at time 1 s',
             partial(processes.plant_again, number=signal.SIGINT)),
    _process('plant-killed', 'the plant is killed and started again',
             partial(processes.plant_again, number=signal.SIGKILL)),
    _process('plant-reset', 'the plant is reset, which makes it 5 K warmer at once',
             processes.plant_reset),
    _process('plant-stopped', 'the plant is stopped (SIGSTOP) for 3 s of wall time',
             processes.plant_stopped),
    _process('controller-killed', 'the controller is killed at rest and started again',
             processes.controller_again, plant=PATIENT, bump=_BUMP),
    _process('controller-killed-in-a-step', 'killed 15 s after a step of the set-point, and '
             'started again', processes.controller_in_a_step, plant=PATIENT),
    _process('controller-killed-while-disturbed', 'killed while the feed is 2 K too warm, and '
             'started again after a minute', processes.controller_while_disturbed, plant=PATIENT,
             afterwards=420.0, recovery=360.0),
    _process('controller-killed-in-manual-mode', 'killed in manual mode, and started again',
             processes.controller_in_manual_mode, plant=PATIENT),
    _process('controller-stopped', 'stopped (SIGSTOP) for 4 s of wall time, 80 s of plant '
             'time, while the set-point steps', processes.controller_stopped,
             plant=processes.RUNNING, settle=100.0, largest_step=processes.RUNNING_STEP,
             afterwards=120.0, recovery=120.0),
    _process('trainer-killed', 'the trainer is killed while it records', processes.trainer_killed),
    _process('disk-full', f'the trainer records to a disk of {processes.DISK}B until it is full',
             processes.disk_full, allowed_errors=('trainer: recording',),
             says=('^trainer: recording: recording to .* stopped',)),
    *(_process(f'model-{spoil}', does, partial(processes.reload, spoil=spoil), bump=_BUMP,
               says=() if spoil == 'changed' else processes.KEPT)
      for spoil, does in (
          ('garbage', 'the model file is overwritten by garbage and read again'),
          ('cut', 'the model file is cut short and read again'),
          ('deleted', 'the model file is deleted and read again'),
          ('changed', 'another lift takes the place of the model file and is read'))),
    _neighbour('two-controllers', 'a second controller, tuned otherwise, commands the same plant, '
               'in turn', processes.second_controller, largest_step=27.0,
               says=processes.TWO_CONTROLLERS),
    _neighbour('two-plants', 'a second plant, 5 K warmer and at another time, measures, too',
               processes.second_plant, True, largest_step=2.0, says=processes.TWO_PLANTS),
    _neighbour('participants', f'{processes.PARTICIPANTS} participants at a time come and go for '
               '5 s', processes.flooded),
    _neighbour('starved', 'two busy processes on each core, while the set-point steps',
               processes.starved, plant=processes.RUNNING, largest_step=processes.RUNNING_STEP,
               settle=100.0, afterwards=100.0, recovery=100.0))

def rejected_values(on: FaultPlant) -> list[dict[str, Any]]:
    """Return parameter values that the controller of a plant must reject."""
    common = {'': (('max_gain', 0.0), ('max_riccati_residual', -1.0),
                   ('measurement_timeout', math.nan), ('model', ''),
                   ('model', '/nowhere/lift.safetensors'), ('model', 3.0))}
    states = {f'{name}.': (('weight', math.nan), ('weight', -1.0), ('weight', 1),
                           ('sensor_min', 1e8)) for name in on.states}
    setpoints = {f'{name}.': (('setpoint_ramp', -1.0), ('setpoint_ramp', -math.inf))
                 for name in on.controlled}
    inputs = {f'{name}.': (('weight', 0.0), ('weight', math.inf), ('weight', 'much'),
                           ('min', 1e6), ('max', -1e6), ('max', math.nan), ('rate_limit', -1.0),
                           ('safe_value', math.inf)) for name in on.inputs}
    return [{prefix + item: wrong} for part in (common, states, setpoints, inputs)
            for prefix, wrongs in part.items() for item, wrong in wrongs]


def _cycled(changes: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    return itertools.islice(itertools.cycle(changes), REQUESTS)


def _parameters(name: str, does: str, make: Callable[[], Iterable[Mapping[str, Any]]],
                rejected: bool = False) -> FaultCase:
    return FaultCase('operators', name, f'{REQUESTS} {does}',
                     partial(operators.storm_of_parameters, make=make, rejected=rejected))


def _setpoints(name: str, does: str, *values: float, code: StatusCode | None = None) -> FaultCase:
    return FaultCase('operators', name, f'set-points at 1 kHz{does}',
                     partial(operators.storm_of_setpoints, asked=tuple(
                    {reactor.TEMPERATURE: value} for value in values)), code=code)


def _constant(name: str, does: str, play: Callable[..., None], **details: Any) -> FaultCase:
    return FaultCase('disturbances', name, does, play,
                     **{'recovery': 360.0, 'afterwards': 600.0, 'offset': 0.01, **details})


_OPERATORS = (
    _parameters('weights-storm', 'changes of both weights by factors of up to 10,000', partial(
        operators.drawn, 0, {'temperature.weight': (-2.0, 2.0), f'{_COOLANT}.weight': (-2.0, 2.0)},
        True)),
    _parameters('limits-storm', 'changes of range and rate of the coolant', partial(
        operators.drawn, 1, {f'{_COOLANT}.min': (5.0, 22.0), f'{_COOLANT}.max': (24.0, 32.0),
                             f'{_COOLANT}.rate_limit': (0.02, 1.0)})),
    _parameters('ramps-storm', 'changes of the ramp of the set-point', partial(
        operators.drawn, 2, {'temperature.setpoint_ramp': (-5.0, 1.0)}, True)),
    _parameters('bad-values-storm', 'parameters that cannot be',
                lambda: _cycled(rejected_values(REACTOR)), True),
    _setpoints('setpoint-storm', ', all the same', *REACTOR.setpoint),
    _setpoints('setpoint-storm-nan', ': NaN', math.nan, code=StatusCode.SETPOINT_NOT_FINITE),
    _setpoints('setpoint-storm-outside', ': 500 and -1e308 degC', 500.0, -1e308,
               code=StatusCode.SETPOINT_OUTSIDE),
    _setpoints('setpoint-storm-alternating', ': 41 and 51 degC in turn', 41.0, 51.0),
    FaultCase('operators', 'mode-once', 'manual mode for a minute, and back, without a bump',
              operators.mode_once, bump=_BUMP),
    FaultCase('operators', 'mode-storm', f'{REQUESTS} changes between automatic and manual mode',
              operators.storm_of_modes),
    *(_constant(name, f'{does}, for good', partial(changed_for_good, parameters=changes))
      for name, does, changes in (
          ('heat-transfer-low', 'UA -20 %', scaled('heat_transfer_coefficient', 0.8)),
          ('heat-transfer-high', 'UA +20 %', scaled('heat_transfer_coefficient', 1.2)),
          ('feed-warm', 'T_i +5 K', {'constants.feed_temperature': 81.85}),
          ('feed-cold', 'T_i -5 K', {'constants.feed_temperature': 71.85}),
          ('concentration-high', 'C_A +10 %', scaled('concentration', 1.1)),
          ('concentration-low', 'C_A -10 %', scaled('concentration', 0.9)))),
    _constant('actuator-lag', 'the coolant follows its command with 5 s, for good, and the '
              'set-point steps',
              partial(changed_for_good, parameters={f'{_COOLANT}.lag': 5.0}, setpoint=(42.0,))),
    _constant('actuator-late', 'commands act one sample late, for good, and the set-point steps',
              partial(changed_for_good, parameters={f'{_COOLANT}.delay': 1.0}, setpoint=(42.0,))),
    # one that winds up goes further than 3 K to the other side
    *(_constant(name, f'the {does} {operators.STUCK_AT:g} degC, 15 min',
                partial(operators.without_the_cold, node=node, usual=usual), worst=3.0)
      for name, does, node, usual in (
          ('actuator-saturated', 'coolant does not get below', 'plant', -20.0),
          ('coolant-limited', 'controller may not command less than', 'controller',
           reactor.coolant_limits()[0]))),
    _constant('noise', 'noise of 0.1 K, for good',
              partial(changed_for_good, parameters={'temperature.measurement_noise': 0.1}),
              band=0.5,
              offset=0.5),
    _constant('two-state', 'the concentration moves, which the model does not know, and the feed '
              'gets 1 K warmer; near the stable point',
              partial(changed_for_good, parameters={'constants.feed_temperature': 77.85}),
              setpoint=(50.5,), plant={**LOCKSTEP, 'system': 'two_state'}))


# The tanks: several signals, of which one may fail, or all at once.

def _tank_messages(on: FaultPlant) -> Iterator[FaultCase]:
    last, half = on.states[-1], on.period / 2.0
    long, short = 60.0 * on.period, 10.0 * on.period
    every = partial(_altered, partial(_on, on), step=on.other,
                    largest_step=2.0 * on.rate * on.period)

    def one(name: str, does: str, make: Maker, seconds: float = short,
            code: StatusCode | None = None, group: str = 'sensor', **details: Any) -> FaultCase:
        return every(group, name, f'{last}: {does}', lambda: interceptor.part(make(), last),
                     seconds, code, **details)

    yield one('nan-one', 'NaN', _shows(math.nan), code=StatusCode.NOT_FINITE)
    yield one('huge-one', '1e300', _shows(1e300), code=StatusCode.OUTSIDE_SENSOR)
    yield one('spike-one', f'+{_SPIKE:g} m in one sample', _shifted(lambda _: _SPIKE), on.period,
              StatusCode.JUMPED)
    yield one('frozen-one', 'bit-identical values', frozen, 60.0, StatusCode.FROZEN)
    yield one('silent-one', 'no measurement', lost, 150.0, StatusCode.NO_MEASUREMENT,
              plant=_SILENT, controller=_BY_CLOCK, largest_step=_LOOK * on.rate,
              says=('^controller: control: no measurement',))
    yield one('lost-one', '30 % lost', lambda: lost(0.3), long, group='messages')
    yield one('doubled-one', 'each comes twice', _twice, long, group='messages')
    yield one('swapped-one', 'each two in the wrong order', interceptor.swapped, long,
              group='messages')
    yield one('contradicted-one', f'comes twice, first {_SPIKE:g} m too high',
              _twins(_SPIKE, first=True), code=StatusCode.JUMPED)
    yield one('late-one', 'each 3 samples late', lambda: delayed(3), long, group='messages')
    yield every('messages', 'lost', 'all: 30 % lost', lambda: lost(0.3), long)
    yield every('messages', 'commands-lost', 'all: 30 % of the commands lost', lambda: lost(0.3),
                long, what='commands')
    yield every('clocks', 'clock-stopped', 'all: stamps do not advance',
                partial(frozen, 'stamp_ns'), short)
    yield every('clocks', 'clock-back', 'all: stamps jump an hour back, and then ahead',
                _stamps(-3600), long, plant={**LOCKSTEP, 'start_time': 10_000.0})
    yield every('clocks', 'clock-forward', 'all: stamps jump an hour ahead, and then back',
                _stamps(3600), long)
    yield one('clock-apart', f'stamps {half:g} s behind those of the others', _stamps(-half),
              group='clocks')


def _tank_operators(on: FaultPlant) -> Iterator[FaultCase]:
    case = partial(_on, on, 'operators')

    def each(wanted: tuple[float, ...]) -> list[dict[str, float]]:
        return [{name: value} for name, value in zip(on.controlled, wanted, strict=True)]

    for name, does, asked, code in (
            ('nan', 'NaN, of each state in turn', each((math.nan,) * len(on.controlled)),
             StatusCode.SETPOINT_NOT_FINITE),
            ('outside', '500 and -1e308, of each state in turn', each((500.0, -1e308)),
             StatusCode.SETPOINT_OUTSIDE),
            ('alternating', 'two pairs in turn, a state at a time',
             each(on.setpoint) + each(on.other), None)):
        yield case(f'setpoints-{name}', f'set-points at 1 kHz: {does}',
                   partial(operators.storm_of_setpoints, asked=tuple(asked)), code=code)
    # the outflow below cannot be less than the inflow from above
    yield case('not-held', 'a set-point that no flow can hold together with the other',
               partial(operators.setpoint_rejected, asked=on.never, says='cannot be held'),
               code=StatusCode.SETPOINT_NOT_HELD)
    yield case('mode-once', 'manual mode for 20 samples, and back, without a bump', partial(
        operators.mode_once, seconds=20.0 * on.period), bump=_TANK_BUMP)
    yield case('mode-storm', f'{REQUESTS} changes between automatic and manual mode',
               operators.storm_of_modes)
    weights = {f'{name}.weight': (exponent - 1.0, exponent + 1.0)
               for names, exponent in ((on.controlled, 4.0), (on.inputs, 0.0)) for name in names}
    yield case('weights-storm', '100 changes of all weights by factors of up to 100', partial(
        operators.storm_of_parameters,
        make=lambda: itertools.islice(operators.drawn(0, weights, True), 100)))
    yield case('bad-values-storm', f'{REQUESTS} parameters that cannot be, of each signal',
               partial(operators.storm_of_parameters, make=lambda: _cycled(rejected_values(on)),
                       rejected=True))


def _tank_processes(on: FaultPlant) -> Iterator[FaultCase]:
    case = partial(_on, on, 'processes')
    yield case('controller-killed', 'the controller is killed at rest and started again',
               processes.controller_again, plant=PATIENT, bump=_TANK_BUMP)
    yield case('controller-killed-in-manual-mode', 'killed in manual mode, and started again',
               processes.controller_in_manual_mode, plant=PATIENT)
    yield case('plant-killed', 'the plant is killed and started again',
               partial(processes.plant_again, number=signal.SIGKILL))
    yield case('plant-reset', 'the plant is reset', processes.plant_reset)
    case = partial(_on, on, 'neighbours', largest_step=math.inf)
    yield case('two-controllers', 'a second controller, tuned otherwise, commands the same plant',
               partial(processes.second_controller, says=tuple(
                   f'^{node}: 2 nodes command the {on.inputs[0]}'
                   for node in ('controller: control', 'plant: simulation'))))
    if len({place.topic for place in on.wiring.measured.values()}) > 1:
        yield case('two-plants', 'a second plant at another time measures, too', partial(
            processes.second_plant, says=(
                f'^controller: control: .*2 nodes publish the {on.states[0]}',)), between=True)


def _tanks(on: FaultPlant) -> list[FaultCase]:
    return [*_tank_messages(on), *_tank_operators(on), *_tank_processes(on)]


# The two tanks are enough for faults that do not depend on the number of signals and topics.
_MANY = {f'{QUADRUPLE_TANK.name}-{name}' for name in (
    'nan-one', 'frozen-one', 'silent-one', 'lost-one', 'late-one', 'contradicted-one',
    'clock-back', 'clock-apart', 'setpoints-alternating', 'not-held', 'mode-once',
    'bad-values-storm', 'controller-killed', 'plant-killed', 'two-controllers')}


# The reactor at its saddle, where it runs away by itself; one of its states is estimated.

_saddle = partial(_altered, partial(_on, SADDLE), largest_step=2.0 * SADDLE.rate)
_FEED = 76.85  # degC
_SADDLE = (
    _saddle('sensor', 'lost', 'no measurement', lost, 5.0),
    _saddle('sensor', 'nan', 'NaN', _shows(math.nan), 5.0, code=StatusCode.NOT_FINITE),
    _saddle('sensor', 'noise-burst', 'noise of 0.5 K', lambda: noise(0.5), 60.0),
    _saddle('sensor', 'outliers', '+20 K in every seventh sample',
            _shifted(lambda seconds: 20.0 * (seconds % 7.0 == 0.0)), 140.0,
            code=StatusCode.JUMPED),
    _saddle('messages', 'measurements-lost', '30 % of the measurements lost', lambda: lost(0.3),
            120.0, step=SADDLE.other),
    _saddle('messages', 'late', 'each measurement 3 samples late', lambda: delayed(3), 60.0,
            step=SADDLE.other),
    _saddle('messages', 'doubled', 'each measurement comes twice', _twice, 120.0,
            step=SADDLE.other),
    _saddle('actuator', 'valve-stuck', 'the coolant does not move', frozen, 20.0,
            step=SADDLE.other, what='commands'),
    *(_on(SADDLE, 'disturbances', name, f'{does}, for good',
          partial(changed_for_good, parameters=parameters), offset=0.3)
      for name, does, parameters in (
          ('jacket-fouled', 'UA -15 %', scaled('heat_transfer_coefficient', 0.85)),
          ('feed-warm', 'T_f +5 K', {'constants.feed_temperature': _FEED + 5.0}),
          ('feed-cold', 'T_f -5 K', {'constants.feed_temperature': _FEED - 5.0}))),
    _on(SADDLE, 'operators', 'setpoint-out-of-reach', 'a set-point of 120 degC',
        partial(operators.setpoint_rejected, asked={reactor.TEMPERATURE: 120.0},
                says='request rejected'), code=StatusCode.SETPOINT_OUTSIDE),
    _on(SADDLE, 'operators', 'temperature-limited', 'the temperature may not exceed '
        f'{operators.LIMIT:g} degC, 1 K below the set-point, 240 s', operators.limited),
    _on(SADDLE, 'processes', 'controller-killed', 'the controller is killed and started again',
        processes.controller_again, plant=PATIENT),
    _on(SADDLE, 'processes', 'solver-missing', 'the controller has no solver of quadratic '
        'programs, and the set-point steps', operators.stepped, missing=('daqp',),
        code=StatusCode.PACKAGE_MISSING))


# Faults that could leave a plant without control while every status is OK, or end a process.

def _silent(on: FaultPlant) -> Iterator[FaultCase]:
    case = partial(_on, on)
    fast: dict[str, Any] = {'plant': _FAST, 'controller': _BY_CLOCK, 'between': True,
                            'largest_step': _LOOK * on.rate,
                            'recovery': 1.5 * on.recovery, 'afterwards': 1.5 * on.afterwards}
    yield case('clocks', 'stamps-cycle', 'the stamps of five measurements come again and again, '
               '150 s', partial(silence.without_news,
                                make=partial(silence.cycle, 5, on.period)), **fast)
    yield case('clocks', 'two-sources', 'another source, 1000 s behind, measures in turn with the '
               'plant while an operator moves the inputs through their range', silence.stray,
               plant=silence.SLOW, between=True, settle=5.0, afterwards=5.0, band=math.inf,
               largest_step=3.0 * on.rate * on.period)
    yield case('laws', 'plans-late', 'no plan of mpc meets its deadline, and a sensor shows NaN '
               'until the safe inputs are commanded, 4 s', partial(
                   altered, make=_shows(math.nan), seconds=4.0), between=True,
               controller=_SHORT_HOLD, worst=_NEAR[on.name])
    yield case('sensor', 'unmeasured', 'no measurement and no watch over it, while an operator '
               'requests a set-point, and then commands inputs manually', silence.unmeasured,
               **{**fast, 'controller': {**_BY_CLOCK, 'measurement_timeout': 0.0}})
    case = partial(_on, on, 'processes')
    yield case('activated-again', 'deactivated and activated in manual mode, the inputs not '
               'measured', silence.activated_again, plant={**PATIENT, **silence.unheard(on)})
    yield case('experiment-ended', 'the trainer moves the inputs instead of the controller, and '
               'is ended (SIGTERM) meanwhile', silence.experiment, plant=PATIENT)
    yield case('cleaned-up', 'cleaned up while requests are on their way, and activated again',
               silence.cleaned_up, plant=PATIENT)
    yield case('no-plug-in', 'laws and estimators that are none are named', silence.no_plug_in)
    yield case('hosted-exit', 'one of two hosted loops names a module that ends the process',
               silence.hosted, allowed_errors=('controller_host: loops',))
    case = partial(_on, on, 'neighbours')
    yield case('open-loop', 'the plant listens for commands on another topic', silence.open_loop,
               plant={'speed': 20.0, **silence.away(on)}, settle=5.0, largest_step=math.inf)
    yield case('demo', 'the demo is started in the same domain', silence.demo)


def _ahead(on: FaultPlant) -> FaultCase:
    return _on(on, 'clocks', 'ahead-one', f'{on.states[-1]}: stamps an hour ahead, 110 samples',
               silence.one_ahead, between=True, largest_step=2.0 * on.rate * on.period)


def _excursion() -> interceptor.Alteration:
    """Show a plant that goes far outside the trained range and comes half the way back."""
    def shown(seconds: float, _: float) -> float:
        if seconds < 80.0:
            return 51.3 - 28.6 * min(seconds / 60.0, 1.0)
        return 22.7 + 18.7 * min((seconds - 80.0) / 13.0, 1.0)

    return value(shown)


_SILENCE = (
    _on(PENDULUM, 'sensor', 'silent', 'no measurement of the angle, from which the rate is '
        'estimated, 10 s: the pendulum falls', silence.silent_pendulum, between=True,
        plant={'speed': 2.0}, controller={
            **_BY_CLOCK, 'measurement_timeout': 1.0, 'hold_timeout': 5.0},
        largest_step=math.inf, allowed_errors=(silence.CONTROL,)),
    *_silent(REACTOR), *_silent(TWO_TANKS), _ahead(TWO_TANKS),
    # one of its sensors has a topic of its own
    _ahead(replace(QUADRUPLE_TANK, wired={**QUADRUPLE_TANK.wired, 'level_4.topic': 'level_4'})),
    _on(REACTOR, 'clocks', 'seconds-stopped', 'the seconds of the stamps do not advance, their '
        'nanoseconds go on, 150 s', partial(silence.without_news,
                                            make=partial(silence.cycle, 1, 1.0)),
        plant={**_FAST, 'sample_period': 0.3}, controller=_BY_CLOCK, between=True,
        largest_step=_LOOK * REACTOR.rate),
    _on(REACTOR, 'laws', 'excursion', 'a sensor shows an excursion to 22.7 degC and back to '
        '41.4 degC, and no plan of mpc meets its deadline', partial(
            altered, make=_excursion, seconds=200.0), between=True, controller=_NEVER_IN_TIME))

_line = partial(_altered, partial(_on, HEATED_LINE), step=HEATED_LINE.other)
_line_operator = partial(_on, HEATED_LINE, 'operators')
_line_process = partial(_on, HEATED_LINE, 'processes')
_HEATED_LINE = (
    _line('sensor', 'nan', 'temperature: NaN', _shows(math.nan), 50.0,
          code=StatusCode.NOT_FINITE),
    _on(HEATED_LINE, 'sensor', 'quality-bad', 'temperature: of bad quality, 50 s',
        partial(operators.bad_quality, seconds=50.0), code=StatusCode.BAD_QUALITY,
        controller={'temperature.quality_topic': operators.QUALITY}),
    _line('sensor', 'feed-nan', 'feed temperature: NaN', _shows(math.nan), 600.0,
          what='disturbances',
          says=('^controller: .*feed_temperature is nan',)),
    _line('sensor', 'feed-lost', 'feed temperature: no measurement', lost, 600.0,
          what='disturbances',
          says=('^controller: control: .*no measurement of feed_temperature',)),
    _line('sensor', 'feed-late', 'feed temperature: 12 samples late', lambda: delayed(12), 600.0,
          what='disturbances'),
    _line('sensor', 'analyser-lost', 'analyser: no value', lost, 1200.0, what='late'),
    _line('sensor', 'analyser-nan', 'analyser: NaN', _shows(math.nan), 1200.0,
          what='late',
          code=StatusCode.ANALYSIS_REJECTED),
    _line('sensor', 'analyser-late', 'analyser: each value later than analysis_delay',
          lambda: delayed(2), 1200.0, what='late', code=StatusCode.ANALYSIS_REJECTED),
    _line('messages', 'measurements-lost', '30 % of the measurements lost', lambda: lost(0.3),
          600.0),
    _line('messages', 'commands-lost', '30 % of the commands lost', lambda: lost(0.3), 600.0,
          what='commands'),
    _line('clocks', 'clock-back', 'stamps jump an hour back, and then ahead', _stamps(-3600),
          600.0, plant={**LOCKSTEP, 'start_time': 10_000.0}),
    _line_process('controller-killed', 'the controller is killed while the set-point steps, and '
                  'started again', processes.controller_in_a_step, plant=PATIENT),
    _line_process('controller-killed-in-manual-mode', 'killed in manual mode, and started again',
                  processes.controller_in_manual_mode, plant=PATIENT),
    _line_process('plant-killed', 'the plant is killed and started again',
                  partial(processes.plant_again, number=signal.SIGKILL)),
    *(_line_process(f'reloaded-{seconds:g}', f'the model is reloaded with a dead time of '
                    f'{seconds:g} s, while the set-point steps',
                    partial(processes.reload_later, seconds=seconds)) for seconds in (32.0, 58.0)),
    _line_operator('modes', 'between manual and automatic mode every 15 s, while the set-point '
                   'steps', operators.modes_in_a_step),
    _line_operator('mode-storm', f'{REQUESTS} changes between automatic and manual mode',
                   operators.storm_of_modes),
    _line_operator('bad-values-storm', f'{REQUESTS} parameters that cannot be',
                   partial(operators.storm_of_parameters,
                           make=lambda: _cycled(rejected_values(HEATED_LINE)), rejected=True)),
    _line_operator('latched', 'NaN until the safe input is latched, which is cleared then',
                   partial(operators.latched, alteration=_shows(math.nan)(), seconds=200.0),
                   between=True, controller={'safe_latch': True}),
    *(_on(HEATED_LINE, 'disturbances', name, f'{does}, for good, and the set-point steps',
          partial(changed_for_good, parameters=parameters, setpoint=HEATED_LINE.other), **details)
      for name, does, parameters, details in (
          ('later', 'dead time +30 %', {'valve.dead_time': 58.5}, {}),
          ('earlier', 'dead time -30 %', {'valve.dead_time': 31.5}, {}),
          ('feed-cold', 'feed 8 K colder', {'constants.feed_temperature': 12.0},
           {'offset': 0.1}),
          ('fouled', 'UA -15 %', {'constants.heat_transfer_coefficient': 2550.0},
           {'offset': 0.1}))))

CASES = {case.name: case for case in (
    *_MESSAGES, *_PROCESSES, *_OPERATORS, *_tanks(TWO_TANKS),
    *(case for case in _tanks(QUADRUPLE_TANK) if case.name in _MANY), *_SADDLE, *_SILENCE,
    *_HEATED_LINE)}
