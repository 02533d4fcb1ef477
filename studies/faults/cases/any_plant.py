# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults that can happen to any plant: to one of several signals, and to several at once."""

from collections.abc import Iterable, Mapping
from functools import partial
import itertools
import math
import signal
from typing import Any

from koopman_ros.reasons import Code
from koopman_ros.units import NANOSECONDS
from studies.faults import interceptor
from studies.faults.case import Case
from studies.faults.cases.messages import altered, Maker
from studies.faults.cases.operators import (
    drawn,
    mode_once,
    REQUESTS,
    storm_of_modes,
    storm_of_parameters,
    storm_of_setpoints,
)
from studies.faults.cases.processes import (
    controller_again,
    controller_in_manual_mode,
    plant_again,
    plant_reset,
    second_controller,
    second_plant,
)
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import Alteration, lost, Packet, part, stamped, value
from studies.faults.plants import LOCKSTEP, PATIENT, Plant, QUADRUPLE_TANK, TWO_TANKS

_BUMP = 0.05  # V, where nothing calls for more
_SPIKE = 0.05  # m, beyond what any of the tanks can do in a sample


def _twins(packet: Packet) -> list[Packet]:
    return [packet._replace(values={
        name: shown + _SPIKE for name, shown in packet.values.items()}), packet]


def _of_one(on: Plant, alter: Alteration) -> Alteration:
    """Alter the last state that is measured, of which the last tank may have no set-point."""
    return part(alter, on.states[-1])


def _messages(on: Plant) -> Iterable[Case]:
    """Faults of one of the sensors while the others are well, and of all messages."""
    last, half, second = on.states[-1], on.period / 2.0, NANOSECONDS
    long, short = 60.0 * on.period, 10.0 * on.period
    # what comes late or under another stamp
    step = {'largest_step': 2.0 * on.rate * on.period}

    def one(name: str, does: str, make: Maker, seconds: float = short, code: Code | None = None,
            group: str = 'sensor', **details: Any) -> Case:
        return case_on(on, group, name, f'{last}: {does}, {seconds:g} s', partial(
            altered, make=lambda: _of_one(on, make()), seconds=seconds, setpoint=on.other),
            between=True, code=code, **{**step, **details})

    def every(name: str, does: str, make: Maker, seconds: float = short, group: str = 'clocks',
              what: str = 'measurements', **details: Any) -> Case:
        return case_on(on, group, name, f'all: {does}, {seconds:g} s', partial(
            altered, make=make, seconds=seconds, setpoint=on.other, what=what), between=True,
            **{**step, **details})

    yield one('nan-one', 'NaN', lambda: value(lambda *_: math.nan), code=Code.NOT_FINITE)
    yield one('huge-one', '1e300', lambda: value(lambda *_: 1e300), code=Code.OUTSIDE_SENSOR)
    yield one('spike-one', f'+{_SPIKE:g} m in one sample',
              lambda: value(lambda _, shown: shown + _SPIKE), on.period, Code.JUMPED)
    yield one('frozen-one', 'bit-identical values', interceptor.frozen, 60.0, Code.FROZEN)
    yield one('silent-one', 'no measurement', lost, 150.0, Code.NO_MEASUREMENT,
              plant={'lockstep': True, 'speed': 60.0}, controller={'use_sim_time': True},
              # the controller looks every 0.1 s of wall time, so every 6 s of the plant's
              largest_step=8.0 * on.rate, says=('^controller: control: no measurement',))
    yield one('lost-one', '30 % lost', lambda: lost(0.3), long, group='messages')
    yield one('doubled-one', 'each comes twice', lambda: interceptor.twice, long,
              group='messages')
    yield one('swapped-one', 'each two in the wrong order', interceptor.swapped, long,
              group='messages')
    yield one('contradicted-one', f'comes twice, first {_SPIKE:g} m too high', lambda: _twins,
              code=Code.JUMPED)
    yield one('late-one', 'each 3 samples late', lambda: interceptor.delayed(3), long,
              group='messages')
    yield every('lost', '30 % lost', lambda: lost(0.3), long, 'messages')
    yield every('commands-lost', '30 % of the commands lost', lambda: lost(0.3), long,
                'messages', 'commands')
    yield every('clock-stopped', 'stamps stand still', partial(interceptor.frozen, 'stamp_ns'))
    yield every('clock-back', 'stamps jump an hour back, and then ahead', lambda: stamped(
        lambda stamp_ns: stamp_ns - 3600 * second), long,
        plant={**LOCKSTEP, 'start_time': 10_000.0})
    yield every('clock-forward', 'stamps jump an hour ahead, and then back', lambda: stamped(
        lambda stamp_ns: stamp_ns + 3600 * second), long)
    yield one('clock-apart', f'stamps {half:g} s behind those of the others', lambda: stamped(
        lambda stamp_ns: stamp_ns - round(half * second)), group='clocks')


def case_on(on: Plant, group: str, name: str, does: str, play: Any, **details: Any) -> Case:
    """Return a case on a plant, at its set-points and times."""
    return Case(group, f'{on.name}-{name}', does, play, **{
        'on': on, 'setpoint': on.setpoint, 'settle': on.settle, 'afterwards': on.afterwards,
        'recovery': on.recovery, 'band': on.band, **details})


def _refused(on: Plant) -> Iterable[Mapping[str, Any]]:
    """Return values that no signal can have."""
    bad = [*({f'{name}.{item}': wrong} for name in on.states for item, wrong in (
        ('weight', math.nan), ('weight', -1.0), ('setpoint_ramp', -1.0), ('sensor_min', 1e8))),
        *({f'{name}.{item}': wrong} for name in on.inputs for item, wrong in (
            ('weight', 0.0), ('min', 1e6), ('max', math.nan), ('rate_limit', -1.0),
            ('safe', math.inf)))]
    return itertools.islice(itertools.cycle(bad), REQUESTS)


def _not_held(loop: FaultHarness) -> None:
    """Ask for what the inputs cannot hold; the set-points of before stay."""
    with loop.fault():
        loop.ask(**loop.on.never)
        loop.wait_for_report('cannot be held')


def _operators(on: Plant) -> Iterable[Case]:
    case = partial(case_on, on, 'operators')

    def storm(name: str, does: str, *asked: Mapping[str, float], code: Code | None = None) -> Case:
        return case(f'setpoints-{name}', f'set-points at 1 kHz: {does}',
                    partial(storm_of_setpoints, asked=asked), code=code)

    def each(wanted: tuple[float, ...]) -> list[dict[str, float]]:
        return [{name: value} for name, value in zip(on.controlled, wanted, strict=True)]

    yield storm('nan', 'NaN, of each state in turn', *each((math.nan,) * len(on.controlled)),
                code=Code.SETPOINT_NOT_FINITE)
    yield storm('outside', '500 and -1e308, of each state in turn', *each(
        (500.0, -1e308)), code=Code.SETPOINT_OUTSIDE)
    yield storm('alternating', 'two pairs in turn, a state at a time',
                *each(on.setpoint), *each(on.other))
    # what flows out below cannot be less than what flows in from above
    yield case('not-held', 'a set-point that no flow can hold beside the other', _not_held,
               code=Code.SETPOINT_NOT_HELD)
    yield case('mode-once', 'manual mode for 20 samples, and back, without a bump', partial(
        mode_once, seconds=20.0 * on.period), bump=_BUMP)
    yield case('mode-storm', f'{REQUESTS} changes between automatic and manual mode',
               storm_of_modes)
    weights = {f'{name}.weight': (exponent - 1.0, exponent + 1.0)
               for names, exponent in ((on.controlled, 4.0), (on.inputs, 0.0)) for name in names}
    yield case('weights-storm', '100 changes of all weights by factors of up to 100', partial(
        storm_of_parameters, make=lambda: itertools.islice(drawn(0, weights, True), 100)))
    yield case('bad-values-storm', f'{REQUESTS} parameters that cannot be, of each signal',
               partial(storm_of_parameters, make=partial(_refused, on), refused=True))


def _processes(on: Plant) -> Iterable[Case]:
    case = partial(case_on, on, 'processes')
    yield case('controller-killed', 'the controller is killed at rest and started again',
               controller_again, plant=PATIENT, bump=_BUMP)
    yield case('controller-killed-in-manual-mode', 'killed in manual mode, and started again',
               controller_in_manual_mode, plant=PATIENT)
    yield case('plant-killed', 'the plant is killed and started again',
               partial(plant_again, number=signal.SIGKILL))
    yield case('plant-reset', 'the plant is reset', plant_reset)
    says = tuple(f'^{node}: 2 nodes command the {on.inputs[0]}'
                 for node in ('controller: control', 'plant: simulation'))
    case = partial(case_on, on, 'neighbours', largest_step=math.inf)
    yield case('two-controllers', 'a second controller, tuned otherwise, commands the same plant',
               partial(second_controller, says=says))
    if len({place.topic for place in on.wiring.measured.values()}) > 1:
        yield case('two-plants', 'a second plant at another time measures, too', partial(
            second_plant, says=(
                f'^controller: control: .*2 nodes publish the {on.states[0]}',)), between=True)


def _all(on: Plant) -> list[Case]:
    return [case for cases in (_messages, _operators, _processes) for case in cases(on)]


# Of what does not depend on the number of signals and topics, the two tanks are enough.
_MANY = {f'{QUADRUPLE_TANK.name}-{name}' for name in (
    'nan-one', 'frozen-one', 'silent-one', 'lost-one', 'late-one', 'contradicted-one',
    'clock-back', 'clock-apart', 'setpoints-alternating', 'not-held', 'mode-once',
    'bad-values-storm', 'controller-killed', 'plant-killed', 'two-controllers')}
CASES = (*_all(TWO_TANKS), *(case for case in _all(QUADRUPLE_TANK) if case.name in _MANY))
