# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of measurements, of messages on their way, and of clocks."""

from collections.abc import Callable
from functools import partial
import math
from typing import Any

from koopman_ros.reasons import Code
from koopman_ros.units import NANOSECONDS
from studies.faults import interceptor
from studies.faults.case import Case
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import Alteration, lost, noise, Packet, stamped, value
from studies.faults.plants import LOCKSTEP, REACTOR

Maker = Callable[[], Alteration]
_BIAS = 'equivalent sensor bias [K]'


def altered(loop: FaultHarness, make: Maker, seconds: float, setpoint: tuple[float, ...] = (),
            wait: float = 0.0, what: str = 'measurements') -> None:
    """Alter measurements or commands for some seconds of plant time, after a step if asked to."""
    if setpoint:
        loop.request(*setpoint)
        loop.run_for(wait)
    with loop.fault():
        loop.alter(seconds, **{what: make()})


def _constant(shown: float) -> Maker:
    """Return the maker of a sensor that shows one value."""
    return lambda: value(lambda *_: shown)


def _shifted(shift: Callable[[float], float]) -> Maker:
    """Return the maker of a sensor that is wrong by so much after so many seconds."""
    return lambda: value(lambda seconds, measured: measured + shift(seconds))


def _biased(loop: FaultHarness) -> None:
    """Nobody can correct a biased sensor, but an operator can be told."""
    with loop.fault():
        loop.interceptor.measurements = _shifted(lambda _: 2.0)()
        loop.run_for(300.0)
        # until figures are published, which happens once a second of wall time
        since = len(loop.trace.statuses)
        shown = loop.wait(lambda: next(
            (status.values[_BIAS] for status in loop.trace.statuses[since:]
             if status.name == 'controller: control'), None), 'no bias is shown')
        loop.trace.notes.append(f'shown as a bias of {shown} K')
        loop.expect(shown is not None and abs(float(shown) - 2.0) < 0.1,
                    f'a bias of 2 K is shown as {shown} K')
        loop.interceptor.measurements = interceptor.unchanged


def _sensor(name: str, does: str, make: Maker, seconds: float, code: Code | None = None,
            **details: Any) -> Case:
    return Case('sensor', name, f'{does}, {seconds:g} s',
                partial(altered, make=make, seconds=seconds), True, code=code, **details)


_SENSOR = (
    _sensor('nan-short', 'NaN', _constant(math.nan), 5.0, Code.NOT_FINITE),
    _sensor('nan-long', 'NaN', _constant(math.nan), 180.0, Code.NOT_FINITE),
    _sensor('infinity', '+inf', _constant(math.inf), 10.0, Code.NOT_FINITE),
    _sensor('minus-infinity', '-inf', _constant(-math.inf), 10.0, Code.NOT_FINITE),
    _sensor('huge', '1e300 degC', _constant(1e300), 10.0, Code.NOT_FINITE),
    _sensor('minus-zero', '-0.0 degC', _constant(-0.0), 10.0, Code.JUMPED),
    _sensor('below-absolute-zero', '-300 degC', _constant(-300.0), 10.0, Code.NOT_FINITE),
    _sensor('out-of-range', '200 degC', _constant(200.0), 20.0, Code.OUTSIDE_SENSOR),
    _sensor('railed', 'at the upper end of its range, 150 degC', _constant(150.0), 60.0,
            Code.JUMPED),
    _sensor('spike-short', '+30 K in one sample', _shifted(lambda _: 30.0), 1.0, Code.JUMPED),
    _sensor('spike-long', '+15 K', _shifted(lambda _: 15.0), 20.0, Code.JUMPED),
    _sensor('spikes', 'a spike of +20 K in every seventh sample',
            _shifted(lambda seconds: 20.0 * (seconds % 7.0 == 0.0)), 140.0, Code.JUMPED),
    _sensor('frozen-at-rest', 'bit-identical values', interceptor.frozen, 120.0),
    Case('sensor', 'frozen-in-a-step', 'bit-identical values, 10 s after a step of the set-point, '
         '90 s', partial(altered, make=interceptor.frozen, seconds=90.0, setpoint=(42.0,),
                        wait=10.0), True, code=Code.FROZEN),
    _sensor('drift', 'drifts by 1 K/min', _shifted(lambda seconds: seconds / 60.0), 180.0),
    Case('sensor', 'bias', 'wrong by +2 K, 300 s and more', _biased, True, recovery=360.0,
         afterwards=420.0),
    _sensor('noise-burst', 'noise of 1 K', lambda: noise(1.0), 60.0),
    _sensor('noise-wild', 'noise of 10 K', lambda: noise(10.0), 60.0, Code.JUMPED),
    _sensor('quantised', 'in steps of 0.5 K, the set-point between two of them',
            lambda: value(lambda _, measured: round(2.0 * measured) / 2.0), 300.0,
            setpoint=(45.8,)),
    _sensor('dropout-short', 'no measurement', lost, 5.0),
    _sensor('dropout-long', 'no measurement', lost, 150.0, Code.NO_MEASUREMENT,
            plant={'lockstep': True, 'speed': 60.0}, controller={'use_sim_time': True},
            # the controller looks every 0.1 s of wall time, so every 6 s of the plant's
            largest_step=8.0, says=('^controller: control: no measurement',)))


def _in_a_step(group: str, name: str, does: str, make: Maker, seconds: float, *,
               what: str = 'measurements', largest_step: float = 2.0, **details: Any) -> Case:
    return Case(group, name, f'{does}, while the set-point steps, {seconds:g} s',
                partial(altered, make=make, seconds=seconds, setpoint=REACTOR.other, what=what),
                True, largest_step=largest_step, **details)


_MESSAGES = tuple(
    _in_a_step('messages', f'{what}-{name}', f'{what}: {does}', make, 120.0, what=what,
               largest_step=largest_step)
    for what, largest_step in (('measurements', 2.0), ('commands', 1.0))
    for name, does, make in (
        ('lost', '30 % lost', lambda: lost(0.3)),
        ('mostly-lost', '80 % lost', lambda: lost(0.8)),
        ('doubled', 'each comes twice', lambda: interceptor.twice),
        ('swapped', 'each two in the wrong order', interceptor.swapped),
        ('late', 'each 3 s late', lambda: interceptor.delayed(3))))

_NO_CLOCK = '^controller: control: use_sim_time is set and nobody publishes /clock'


def _moved(seconds: int) -> Maker:
    return lambda: stamped(lambda stamp_ns: stamp_ns + seconds * NANOSECONDS)


def _jittered(stamp_ns: int) -> int:
    """Return a stamp that is up to 0.4 s early or late, the same in every run."""
    milliseconds = stamp_ns // NANOSECONDS * 7919 % 800 - 400
    return stamp_ns + milliseconds * 1_000_000


def _twin(packet: Packet) -> list[Packet]:
    return [packet, packet._replace(values={
        name: value + 0.01 for name, value in packet.values.items()})]


def _without_clock(loop: FaultHarness) -> None:
    with loop.fault():
        loop.request(*REACTOR.other)
        loop.wait_for_report(_NO_CLOCK)


_clock = partial(_in_a_step, 'clocks')
CASES = (
    *_SENSOR, *_MESSAGES,
    _clock('clock-forward', 'stamps jump an hour ahead, and then back', _moved(3600), 120.0),
    _clock('clock-back', 'stamps jump an hour back, and then ahead', _moved(-3600), 120.0,
           plant={**LOCKSTEP, 'start_time': 10_000.0}),
    _clock('clock-far', 'stamps jump 60 years ahead, and then back', _moved(1_900_000_000), 60.0),
    _clock('clock-zero', 'stamps are zero', lambda: stamped(lambda _: 0), 30.0),
    _clock('clock-stopped', 'stamps stand still', partial(interceptor.frozen, 'stamp_ns'), 30.0,
           says=('^controller: control: .*does not advance',)),
    _clock('clock-jitter', 'stamps are up to 0.4 s wrong', lambda: stamped(_jittered), 120.0),
    _clock('clock-twins', 'two measurements with each stamp', lambda: _twin, 60.0),
    Case('clocks', 'no-clock', 'use_sim_time is set, and nobody publishes /clock', _without_clock,
         plant={**LOCKSTEP, 'publish_clock': False}, controller={'use_sim_time': True},
         says=(_NO_CLOCK,)))
