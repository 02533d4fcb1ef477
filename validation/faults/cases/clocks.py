# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of clocks: stamps that jump, stand still or are zero, and a clock that is missing."""

from collections.abc import Callable
from typing import Any

from koopman_ros.units import NANOSECONDS
from validation.faults.alterations import Alteration, Packet, stamped, stamps_frozen
from validation.faults.case import Case, case
from validation.faults.cases.sensor import altered
from validation.faults.harness import FaultHarness, LOCKSTEP

GROUP = 'clocks'


def _jittered(stamp_ns: int) -> int:
    """Return a stamp that is up to 0.4 s early or late, the same in every run."""
    milliseconds = stamp_ns // NANOSECONDS * 7919 % 800 - 400
    return stamp_ns + milliseconds * 1_000_000


_NO_CLOCK = '^controller: control: use_sim_time is set and nobody publishes /clock'


def _stopped(loop: FaultHarness) -> None:
    loop.begin()
    loop.request(44.0)
    loop.wait_for_report(_NO_CLOCK)
    loop.end()


def _twin(packet: Packet) -> list[Packet]:
    return [packet, packet._replace(celsius=packet.celsius + 0.01)]


def _case(name: str, does: str, make: Callable[[], Alteration], seconds: float, **details: Any
          ) -> Case:
    return case(GROUP, name, f'{does}, while the set-point steps, {seconds:g} s',
                altered(make, seconds, 44.0), between=True, largest_step=2.0, **details)


def _shifted(seconds: int) -> Callable[[], Alteration]:
    return lambda: stamped(lambda stamp_ns: stamp_ns + seconds * NANOSECONDS)


CASES = (
    _case('clock-forward', 'stamps jump an hour ahead, and then back', _shifted(3600), 120.0),
    _case('clock-back', 'stamps jump an hour back, and then ahead', _shifted(-3600), 120.0,
          plant={**LOCKSTEP, 'start_time': 10_000.0}),
    _case('clock-far', 'stamps jump 60 years ahead, and then back', _shifted(1_900_000_000), 60.0),
    _case('clock-zero', 'stamps are zero', lambda: stamped(lambda _: 0), 30.0),
    _case('clock-stopped', 'stamps stand still', stamps_frozen, 30.0,
          says=('^controller: control: .*does not advance',)),
    _case('clock-jitter', 'stamps are up to 0.4 s wrong', lambda: stamped(_jittered), 120.0),
    _case('clock-twins', 'two measurements with each stamp', lambda: _twin, 60.0),
    case(GROUP, 'no-clock', 'use_sim_time is set, and nobody publishes /clock', _stopped,
         plant={**LOCKSTEP, 'publish_clock': False}, controller={'use_sim_time': True},
         says=(_NO_CLOCK,)),
)
