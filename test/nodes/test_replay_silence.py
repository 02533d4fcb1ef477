# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Replays of a controller that commanded by itself, or began from the coolant in force."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.bags import BagWriter, message_definition
from koopman_ros.control import Rung, State
from koopman_ros.lifting import load
from koopman_ros.nodes import replay, topics, translation
from koopman_ros.nodes.messages import NANOSECONDS, to_celsius
from koopman_ros.nodes.replay_parameters import ReplayParameters
from koopman_ros.nodes.replaying.comparison import ReplayedBag
from koopman_ros.nodes.replaying.inputs import Silence, TakeOver
from koopman_ros.nodes.replaying.record import Names
from koopman_ros.nodes.shipped import model_path
from koopman_ros.testing import Harness
from support.messages import seconds, temperature

STEADY = 51.8  # degC
COOLANT = 24.5  # degC, not what the law would command
SETTINGS = {'hold_timeout': 0.5, 'coolant_rate_limit': 600.0}


def replayed(bag: Path, **settings: float) -> ReplayedBag:
    parameters = ReplayParameters(**{'new_model': 'reactor_nz4', **SETTINGS, **settings})
    return replay.replayed_bag(str(bag), Names(), parameters)


def operations(found: ReplayedBag, kind: type) -> list[int]:
    """Return the places of the measurements before which something happened."""
    return [k for k, sample in enumerate(found.replayed.samples)
            for entry in sample.operations if isinstance(entry.message, kind)]


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a controller that starts from a coolant, and twice hears nothing for a while."""
    folder = tmp_path_factory.mktemp('silent')
    with Harness(folder) as ros:
        ros.start('trainer', {'output': folder / 'bag'})
        commands = ros.listen(Temperature, topics.COOLANT_SETPOINT)
        coolant = ros.node.create_publisher(
            Temperature, topics.COOLANT_TEMPERATURE, topics.LATCHED_QOS)
        coolant.publish(temperature(COOLANT, 1.0))
        ros.start('controller', {**SETTINGS, 'measurement_timeout': 0.2})
        thermometer = ros.speak(
            Temperature, topics.TEMPERATURE, to='controller', subscribers=2)
        ros.wait_until(lambda: coolant.get_subscription_count() >= 2)
        ros.meet('trainer')

        def measure(first: float, count: int) -> None:
            for k in range(count):
                now = first + k
                thermometer.publish(temperature(STEADY - 0.01 * k, now))
                ros.wait_until(lambda now=now: any(seconds(m) == now for m in commands))

        measure(1.0, 30)
        assert commands[0].temperature == COOLANT
        # held, and then at the safe coolant
        for first, silent in ((50.0, 0.2), (100.0, 1.4)):
            last = commands[-1]
            ros.wait_until(lambda last=last, silent=silent: (
                seconds(commands[-1]) > seconds(last) + silent))
            measure(first, 30)
        assert ros.set_bool('trainer/record', False).success
    return folder / 'bag'


def test_start_from_the_coolant_in_force_and_silences_are_reproduced_to_the_bit(bag: Path
                                                                               ) -> None:
    found = replayed(bag)
    assert found.check.identical == found.check.compared >= 87
    assert found.new is not None
    assert found.new.identical == found.check.compared
    assert operations(found, TakeOver) == [0]
    # on a busy machine there may be more than those two
    assert set(operations(found, Silence)) >= {30, 60}
    assert found.record.silences == len(operations(found, Silence)) >= 4
    assert found.record.unmatched_commands == 0
    # the safe coolant had been on its way when measurements came again
    assert found.recorded[60] < found.recorded[29] - 1.0


def test_other_settings_of_the_watchdog_are_found_out(bag: Path) -> None:
    found = replayed(bag, hold_timeout=60.0)
    assert found.check.identical < found.check.compared


# The same without a recorder, which may hear of two topics in either order.


def write(path: Path, messages: Iterable[tuple[str, float, float, float]]) -> Path:
    """Write temperatures: (topic, degC, stamp, time of receipt)."""
    kind = 'sensor_msgs/msg/Temperature'
    with BagWriter(path) as writer:
        for topic, celsius, stamp, received in messages:
            writer.add_topic(topic, message_definition(kind))
            writer.write(topic, serialize_message(temperature(celsius, stamp)),
                         round(received * NANOSECONDS))
    return path


def test_start_shows_in_the_first_command_where_the_coolant_was_not_recorded(tmp_path: Path
                                                                            ) -> None:
    controller = translation.controller_of(
        load(model_path('reactor_nz4')), ReplayParameters(**SETTINGS).settings())
    state = translation.take_over(controller, State(), temperature(COOLANT))
    messages = []
    for k in range(1, 30):
        measured = STEADY - 0.01 * k
        state, kelvin, _ = translation.answer(controller, state, temperature(measured, float(k)))
        messages += [('/temperature', measured, float(k), float(k)),
                     ('/coolant_setpoint', to_celsius(kelvin), float(k), k + 0.001)]
    found = replayed(write(tmp_path / 'bag.mcap', messages))
    assert operations(found, TakeOver) == [0]
    # what it was found by is not compared
    assert found.check.identical == found.check.compared == 28


@pytest.mark.parametrize('late', [-0.001, 0.001])
def test_silence_is_placed_by_the_order_of_the_commands(tmp_path: Path, late: float) -> None:
    """Whichever the recorder hears first: what was commanded in silence, or what ended it."""
    controller = translation.controller_of(
        load(model_path('reactor_nz4')), ReplayParameters(**SETTINGS).settings())
    state, messages = State(), []
    for k, stamp in enumerate((1.0, 2.0, 3.0, 4.0, 20.0, 21.0, 22.0)):
        measured = STEADY - 0.01 * k
        if stamp == 20.0:
            for silent in (14.0, 19.0):
                state, held, report = translation.watch(
                    controller, state, round(silent * NANOSECONDS))
                assert held is not None
                assert report.rung in (Rung.HOLD, Rung.SAFE)
                messages.append(('/coolant_setpoint', to_celsius(held), silent, 20.0 + late))
        state, kelvin, _ = translation.answer(controller, state, temperature(measured, stamp))
        messages += [('/temperature', measured, stamp, stamp),
                     ('/coolant_setpoint', to_celsius(kelvin), stamp, stamp + 0.002)]
    found = replayed(write(tmp_path / 'bag.mcap', messages))
    assert operations(found, Silence) == [4, 4]
    assert found.check.identical == found.check.compared == 7
