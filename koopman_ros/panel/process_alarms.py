# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Alarms of measurements: high, low, and the deviation from the set-point."""

from collections.abc import Iterator

from koopman_ros.panel.alarms import Alarms, Priority
from koopman_ros.parameters.panel import ProcessLimits


class ProcessAlarms:
    """Reports measurements beyond their limits."""

    def __init__(self, alarms: Alarms) -> None:
        self._alarms = alarms
        self._beyond: set[str] = set()  # keys of the limits that are exceeded

    def take(self, label: str, unit: str, value: float, setpoint: float, limits: ProcessLimits,
             now: float) -> None:
        """
        Take a measurement.

        :param label: name of the signal for people.
        :param setpoint: NaN if the signal is not controlled at present.
        """
        for what, excess, priority, text in self._excesses(value, setpoint, limits, unit):
            key = f'process: {label}: {what}'
            beyond = excess > (-limits.deadband if key in self._beyond else 0.0)
            (self._beyond.add if beyond else self._beyond.discard)(key)
            self._alarms.report(key, beyond, priority, f'{label} {value:.5g} {unit} {text}', now,
                                limits.delay)

    @staticmethod
    def _excesses(value: float, setpoint: float, limits: ProcessLimits, unit: str
                  ) -> Iterator[tuple[str, float, Priority, str]]:
        """Yield the name, excess, priority and text of each limit."""
        yield ('high', value - limits.high, Priority.HIGH,
               f'is above its high limit {limits.high:.5g} {unit}')
        yield ('low', limits.low - value, Priority.HIGH,
               f'is below its low limit {limits.low:.5g} {unit}')
        yield ('deviation', abs(value - setpoint) - limits.deviation, Priority.MEDIUM,
               f'is {abs(value - setpoint):.3g} from the set-point, more than '
               f'{limits.deviation:.3g}')
