# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A recorded run, read from its bags, and the figures of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

# a missing matplotlib ends the demo before its run, not after
import matplotlib.figure  # noqa: F401
import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import conversion, NANOSECONDS
from koopman_ros.demo.loop import BUSY, FIRST_STAMP_NS
from koopman_ros.parameters.signal_topics import SignalTopics
from koopman_ros.records import read_series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AVERAGED = 600.0  # s over which an offset is averaged


@dataclass(frozen=True)
class DemoRun:
    """A recorded loop, possibly over several bags; times in s since the first measurement."""

    seconds: Array  #: (n,) of the measurements
    measured: Mapping[str, Array]  #: (n,) by signal, in its unit
    command_seconds: Array  #: (m,) of the commands
    commanded: Mapping[str, Array]  #: (m,) by signal, in its unit

    def final_error(self, signal: str, setpoint: float) -> float:
        """Return the last measurement minus the set-point."""
        return float(self.measured[signal][-1] - setpoint)

    def settling_time(self, signal: str, setpoint: float, step_time: float, tolerance: float
                      ) -> float | None:
        """Return the seconds from the step until the error stays within a tolerance, or None."""
        outside = np.flatnonzero(np.abs(self.measured[signal] - setpoint) > tolerance)
        last = int(outside[-1]) if len(outside) else -1
        if last + 1 >= len(self.seconds):
            return None
        return max(0.0, float(self.seconds[last + 1]) - step_time)

    def offset(self, signal: str, setpoint: float, end: float) -> float:
        """Return the size of the mean error over the ten minutes before a time."""
        rows = (self.seconds > end - _AVERAGED) & (self.seconds <= end)
        return float(abs(np.mean(self.measured[signal][rows] - setpoint)))

    def largest_step(self, signal: str, start: float, end: float) -> float:
        """Return the largest change from one command to the next between two times."""
        rows = (self.command_seconds >= start) & (self.command_seconds <= end)
        return float(np.max(np.abs(np.diff(self.commanded[signal][rows]))))


def read_signal(bag: Path, place: MessageField, unit: str) -> tuple[Array, Array]:
    """Return the seconds since the first measurement and the values of a signal, in a unit."""
    found = read_series(bag, replace(place, topic=f'/{place.topic}'))
    return ((found.stamp_ns - FIRST_STAMP_NS) / NANOSECONDS,
            conversion(place.unit, unit)(found.values))


def read_run(wiring: SignalTopics, *bags: Path) -> DemoRun:
    """
    Read the bags of one run, in their order.

    :raises ValueError: for a single bag that lacks messages.
    """
    stamps: dict[str, Array] = {}

    def series(places: Mapping[str, MessageField], units: Mapping[str, str]) -> dict[str, Array]:
        found = {}
        for name, place in places.items():
            parts = [read_series(bag, replace(place, topic=f'/{place.topic}')) for bag in bags]
            stamps[name] = np.concatenate([part.stamp_ns for part in parts])
            found[name] = conversion(place.unit, units[name])(
                np.concatenate([part.values for part in parts]))
        return found

    measured = series(wiring.measured, wiring.signals.states)
    commanded = series(wiring.commands, wiring.signals.inputs)
    if len(bags) == 1:
        _check_complete(bags[0], stamps)
    measured_ns, commanded_ns = (stamps[next(iter(of))] for of in (measured, commanded))
    origin = measured_ns[0]
    return DemoRun((measured_ns - origin) / NANOSECONDS, measured,
                   (commanded_ns - origin) / NANOSECONDS, commanded)


def _check_complete(bag: Path, stamps: Mapping[str, Array]) -> None:
    """Raise a ValueError if signals that are sampled together lack samples before the last."""
    found = np.unique(np.concatenate(list(stamps.values())))
    period = np.diff(found).min(initial=2 ** 62)
    # a plant that is stopped gets no answer to its last measurement
    expected = np.arange(np.rint((found[-1] - found[0]) / period))
    lost = {name: len(np.setdiff1d(expected, np.rint((of - found[0]) / period)))
            for name, of in stamps.items()}
    if any(lost.values()):
        raise ValueError(f'{bag} lacks ' + ', '.join(
            f'{missing} of {len(expected) + 1} samples of {name}'
            for name, missing in lost.items() if missing) + f': {BUSY}')


def draw_phases(panels: Sequence[Axes], phases: Sequence[tuple[str, float]]) -> None:
    """Mark the start of each phase, in s, in all panels over minutes; name it in the first."""
    low, high = panels[0].get_ylim()
    panels[0].set_ylim(low, high + 0.18 * (high - low))
    for number, (name, start) in enumerate(phases):
        for axes in panels:
            axes.axvline(start / 60.0, color='0.7', linewidth=0.8)
        # in two rows in turn: phases may be short
        panels[0].text(start / 60.0, high + (0.17, 0.08)[number % 2] * (high - low), f' {name}',
                       va='top', fontsize=9)
