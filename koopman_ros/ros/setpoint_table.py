# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Set-points over time from a CSV, as the messages that request them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
import math

import numpy as np
from rclpy.clock import Clock
from rclpy.serialization import serialize_message

from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import conversion, display_unit, NANOSECONDS
from koopman_ros.parameters.player import PlayerParameters
from koopman_ros.parameters.signal_topics import SignalTopics
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.records import BagMessage, BagSummary
from koopman_ros.records.tables import table_of
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.ros.topics import message_class


@dataclass(frozen=True)
class SetpointTable:
    """Set-points by signal, in the units of their messages."""

    places: Mapping[str, MessageField]
    trajectories: Mapping[str, tuple[Array, Array]]  #: times in s from the first row, and values

    @staticmethod
    def read(settings: PlayerParameters, wiring: SignalTopics | None) -> 'SetpointTable':
        """
        Read the CSV of a player.

        :raises ConfigurationError: for a file without times, or without a controlled signal.
        """
        if wiring is None:
            raise ConfigurationError(
                f'system = {settings.system!r} has no set-points: name a plant of config/plants')
        try:
            table = table_of(settings.bag)
            times = table.seconds('', 0.0, None)
            trajectories = {}
            for name, place in wiring.setpoints.items():
                if (column := table.find(name)) is None:
                    continue
                convert = conversion(table.unit(column) or display_unit(
                    wiring.signals.states[name]), place.unit)
                values = table.numbers(column)
                given = np.isfinite(times) & np.isfinite(values)
                trajectories[name] = _trajectory(times[given], np.array(
                    [convert(value) for value in values[given].tolist()]), settings)
        except (OSError, ValueError) as error:
            raise ConfigurationError(f'{settings.bag}: {error}') from error
        if not trajectories:
            raise ConfigurationError(
                f'{settings.bag} has no column {" or ".join(wiring.setpoints)}: name the columns '
                'time [s] and <signal> [unit]')
        return SetpointTable(wiring.setpoints, trajectories)

    @property
    def content(self) -> BagSummary:
        """The messages as those of a bag."""
        topics = {name: f'/{self.places[name].topic.lstrip("/")}' for name in self.trajectories}
        return BagSummary(
            {topics[name]: len(times) for name, (times, _) in self.trajectories.items()},
            {topics[name]: self.places[name].type for name in self.trajectories}, {}, None, None,
            True)

    def messages(self, clock: Clock, lead: float) -> Iterator[BagMessage]:
        """Yield the messages in the order of their times, the first one now."""
        begin_ns = clock.now().nanoseconds
        rows = sorted((time, name, value) for name, trajectory in self.trajectories.items()
                      for time, value in zip(*(part.tolist() for part in trajectory), strict=True))
        for time, name, value in rows:
            place = self.places[name]
            message = message_class(place.type)()
            place.put(message, value)
            if lead and hasattr(message, 'header'):
                message.header.stamp = stamp_message(begin_ns + round(time * NANOSECONDS))
            sent_ns = round(max(0.0, time - lead) * NANOSECONDS)
            yield BagMessage(f'/{place.topic.lstrip("/")}', place.type, sent_ns, sent_ns, message,
                             serialize_message(message))


def _trajectory(times: Array, values: Array, settings: PlayerParameters) -> tuple[Array, Array]:
    """Return times and values of steps, or of ramps between them."""
    if (np.diff(times) < 0.0).any():
        raise ValueError('the times do not increase: sort the rows')
    if not settings.setpoint_ramps or len(times) < 2:
        return times, values
    count = math.floor((times[-1] - times[0]) / settings.ramp_period)
    every = np.union1d(times, times[0] + settings.ramp_period * np.arange(count + 1))
    return every, np.interp(every, times, values)
