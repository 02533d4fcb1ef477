# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What acted on which measurement, as read from bags."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from koopman_ros.bags import (
    Account,
    BagReadError,
    BagWriter,
    loop_episodes,
    message_definition,
)
from koopman_ros.plant_data import Episode

TEMPERATURE, COOLANT = '/temperature', '/coolant_setpoint'
TYPE = 'sensor_msgs/msg/Temperature'
SECOND = 1_000_000_000
# what the wall clock says where stamps are simulated
WALL = 1_700_000_000 * SECOND


@dataclass(frozen=True)
class Said:
    """A message: topic, stamp [s], value [degC], receipt [s after WALL; the stamp's if None]."""

    topic: str
    stamp: float
    value: float
    received: float | None = None


def measured(*seconds: float, value: float | None = None) -> list[Said]:
    """Return measurements whose value tells their stamp."""
    return [Said(TEMPERATURE, t, t if value is None else value) for t in seconds]


def loop(count: int, first: int = 1) -> list[Said]:
    """Return measurements a second, each with its answer ten milliseconds later."""
    return [said for k in range(first, first + count) for said in (
        Said(TEMPERATURE, k, float(k)), Said(COOLANT, k, 100.0 + k, k + 0.01))]


@pytest.fixture
def write(samples: Any, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes what was said to a bag; it can be left unclosed."""
    serialize = importlib.import_module('rclpy.serialization').serialize_message
    message = importlib.import_module('sensor_msgs.msg').Temperature
    time = importlib.import_module('builtin_interfaces.msg').Time

    def write(said: Iterable[Said], name: str = 'run.mcap', *, wall: bool = False,
              closed: bool = True) -> Path:
        writer = BagWriter(tmp_path / name)
        definition = message_definition(TYPE)
        writer.add_topic(TEMPERATURE, definition)
        writer.add_topic(COOLANT, definition)
        for number, one in enumerate(said):
            stamp_ns = round(one.stamp * SECOND) + (WALL if wall and one.stamp else 0)
            written = message(temperature=float(one.value))
            written.header.stamp = time(sec=stamp_ns // SECOND, nanosec=stamp_ns % SECOND)
            received = one.stamp if one.received is None else one.received
            writer.write(one.topic, serialize(written), WALL + round(received * SECOND))
            if number % 20 == 19:
                writer.flush()
        before = writer.mcap_path.read_bytes()
        writer.close()
        if not closed:
            writer.mcap_path.write_bytes(before)
        return tmp_path / name

    return write


def read(*bags: Path) -> tuple[list[Episode], Account]:
    episodes, account = loop_episodes(bags, TEMPERATURE, COOLANT)
    assert account.used == sum(map(len, episodes))
    assert account.lines()[0] == f'{account.used} of {account.measurements} measurements used'
    return episodes, account


def stamps(episode: Episode) -> list[float]:
    """Return the seconds of the measurements, of which the value of the first one tells."""
    return (episode.time + episode.x[0, 0]).tolist()


def acts(episode: Episode) -> list[float]:
    """Return the seconds from which the inputs act."""
    return (episode.input_time + episode.x[0, 0]).tolist()


# What acts when.


def test_lock_step_answers_act_from_their_stamp_on(write: Callable[..., Path]) -> None:
    (episode,), account = read(write(loop(20)))
    assert stamps(episode) == list(range(1, 21))
    assert episode.x[:, 0].tolist() == list(range(1, 21))
    # the last command acts after the last measurement, and does not count
    assert acts(episode) == list(range(1, 20))
    assert episode.u[:, 0].tolist() == [100.0 + k for k in range(1, 20)]
    assert account.lines() == ['20 of 20 measurements used']


def test_wall_clock_answers_act_when_they_arrive(write: Callable[..., Path]) -> None:
    said = [s for k in range(1, 21) for s in (
        Said(TEMPERATURE, k, float(k), k + 0.02),
        # 120 ms later than its measurement, by the recorder's clock
        Said(COOLANT, k, 100.0 + k, k + 0.14))]
    (episode,), _ = read(write(said, wall=True))
    # the first measurement was taken before any command
    assert stamps(episode) == list(range(2, 21))
    assert acts(episode)[:3] == pytest.approx([1.12, 2.12, 3.12])


def test_short_delay_counts_as_none(write: Callable[..., Path]) -> None:
    said = [s for k in range(1, 21) for s in (
        Said(TEMPERATURE, k, float(k), k + 0.02), Said(COOLANT, k, 100.0 + k, k + 0.025))]
    (episode,), _ = read(write(said, wall=True))
    assert acts(episode) == list(range(1, 20))


def test_one_stray_receipt_does_not_hide_the_wall_clock(write: Callable[..., Path]) -> None:
    said = [s for k in range(1, 21) for s in (
        Said(TEMPERATURE, k, float(k), k + (9.0 if k == 20 else 0.02)),
        Said(COOLANT, k, 100.0 + k, k + 0.14))]
    said.sort(key=lambda s: s.received or 0.0)
    (episode,), _ = read(write(said, wall=True))
    assert acts(episode)[0] == pytest.approx(1.12)


def test_coolant_that_stays_is_one_input(write: Callable[..., Path]) -> None:
    levels = [20.0] * 7 + [25.0] * 7 + [20.0] * 6
    said = [s for k, level in enumerate(levels, 1)
            for s in (*measured(k), Said(COOLANT, k, level))]
    (episode,), _ = read(write(said))
    assert acts(episode) == [1.0, 8.0, 15.0]
    assert episode.u[:, 0].tolist() == [20.0, 25.0, 20.0]


def test_commands_between_measurements_keep_their_time(write: Callable[..., Path]) -> None:
    said = [Said(COOLANT, 0.5, 20.0), *measured(*range(1, 12)), Said(COOLANT, 5.25, 30.0),
            Said(COOLANT, 5.75, 10.0)]
    (episode,), _ = read(write(said))
    assert acts(episode) == [0.5, 5.25, 5.75]


def test_dead_time_of_the_actuator(write: Callable[..., Path]) -> None:
    (episode,), account = loop_episodes([write(loop(20))], TEMPERATURE, COOLANT,
                                        input_delay_ns=2 * SECOND + 1)
    # to the nanosecond, from the first measurement on, at 4 s
    assert episode.input_time[:3].tolist() == [1e-9 - 1.0, 1e-9, 1e-9 + 1.0]
    assert episode.u[:3, 0].tolist() == [101.0, 102.0, 103.0]
    # nobody knows what acted before
    assert stamps(episode)[0] == 4.0
    assert account.dropped == {'before the first coolant': 3}


def test_last_word_for_a_measurement_counts(write: Callable[..., Path]) -> None:
    said = [*loop(12), Said(COOLANT, 5.0, 77.0, 5.2)]
    said.sort(key=lambda s: s.stamp if s.received is None else s.received)
    (episode,), _ = read(write(said))
    assert episode.u[4, 0] == 77.0
    assert len(episode.u) == 11


@pytest.mark.parametrize('wall', [True, False])
def test_commands_without_a_stamp_act_when_received(write: Callable[..., Path], wall: bool
                                                    ) -> None:
    # where stamps are simulated the plant runs ten times as fast as the recorder's clock
    pace = 1.0 if wall else 0.1
    said = [Said(TEMPERATURE, k, float(k), k * pace) for k in range(1, 31)]
    said += [Said(COOLANT, 0.0, 20.0, 1.5 * pace), Said(COOLANT, 0.0, 25.0, 12.25 * pace)]
    said.sort(key=lambda s: s.received or 0.0)
    (episode,), account = read(write(said, wall=wall))
    # the clocks' nanoseconds since 1970 are told apart to some hundred
    assert acts(episode) == pytest.approx([1.5, 12.25], abs=1e-5)
    assert account.lines() == ['29 of 30 measurements used', '1 dropped: before the first coolant']


# What ends an episode, and what is left out.


def test_gap_ends_an_episode(write: Callable[..., Path]) -> None:
    bag = write([*loop(15), *loop(12, 40)])
    (first, second), account = read(bag)
    assert stamps(first)[-1] == 15.0
    assert stamps(second)[0] == 40.0
    # the coolant of the second one begins with the last command before it
    assert acts(second)[0] == 40.0
    assert account.notes == [
        f'{bag}: gap of 25.000 s at 15.000 s, a new episode begins']


def test_a_few_lost_samples_are_no_gap(write: Callable[..., Path]) -> None:
    said = [s for s in loop(20) if not (s.topic == TEMPERATURE and s.stamp in (7.0, 8.0))]
    (episode,), account = read(write(said))
    assert len(episode) == 18
    assert account.lines() == ['18 of 18 measurements used']


def test_spike_is_dropped_and_jump_ends_an_episode(write: Callable[..., Path]) -> None:
    added = {k: 500.0 if k == 40 else 300.0 * (k > 70) for k in range(1, 121)}
    said = [replace(one, value=one.value + added[round(one.stamp)])
            if one.topic == TEMPERATURE else one for one in loop(120)]
    bag = write(said)
    (first, second), account = read(bag)
    assert stamps(first) == [*range(1, 40), *range(41, 71)]
    assert (second.time + 71.0).tolist() == list(range(71, 121))
    assert second.x[0, 0] == 371.0
    assert account.dropped == {'spike of a single sample': 1}
    assert account.notes == [
        f'{bag}: jump to 371.00 degC at 70.000 s, a new episode begins']


def test_command_before_a_gap_is_held_over_it(write: Callable[..., Path]) -> None:
    said = [Said(COOLANT, 0.5, 20.0), *measured(*range(1, 13)), *measured(*range(60, 72))]
    (first, second), _ = read(write(said))
    assert [acts(e) for e in (first, second)] == [[0.5], [0.5]]


def test_time_set_back_begins_anew(write: Callable[..., Path]) -> None:
    restarted = [Said(s.topic, s.stamp, s.value + 500.0, (s.received or s.stamp) + 100.0)
                 for s in loop(12)]
    bag = write([*loop(30), *restarted])
    (first, second), account = read(bag)
    assert (len(first), len(second)) == (30, 12)
    assert second.x[0, 0] == 501.0
    # what acted before is not what acts now
    assert second.u[0, 0] == 601.0
    assert account.notes == [
        f'{bag}: time was set back by 29.000 s, a new episode begins']


def test_what_happens_often_is_told_once(write: Callable[..., Path]) -> None:
    set_back = [part for k in range(500) for part in (
        Said(TEMPERATURE, 10.0 + 0.01 * k, 50.0, float(k)), Said(COOLANT, 5.0, 20.0, float(k)),
        Said(TEMPERATURE, 5.0, 50.0, k + 0.5))]
    gaps = [Said(topic, 100.0 + 40.0 * k + (k > 6) + t, 20.0, 5000.0 + 40.0 * k + t)
            for k in range(9) for t in range(12) for topic in (COOLANT, TEMPERATURE)]
    bag = write([*set_back, *gaps])
    episodes, account = read(bag)
    assert len(episodes) == 9
    assert account.notes == [
        f'{bag}: time was set back by 5.000 s, the first of 500, at most by 9.990 s; a new '
        'episode begins at each',
        f'{bag}: gap of 95.000 s at 5.000 s, the first of 9, the longest of 95.000 s at 5.000 s; '
        'a new episode begins at each']


def test_late_and_repeated_stamps_are_put_in_order(write: Callable[..., Path]) -> None:
    said = loop(20)
    # 5.5 s arrives after 6 s; 9 s comes twice, with another value
    said.insert(12, Said(TEMPERATURE, 5.5, 5.5, 6.2))
    said.insert(20, Said(TEMPERATURE, 9.0, 999.0, 9.9))
    (episode,), account = read(write(said))
    assert 5.5 in episode.x
    assert 999.0 not in episode.x
    assert np.all(np.diff(episode.time) > 0)
    assert account.lines() == [
        '21 of 22 measurements used', '1 dropped: measurement with a repeated stamp']


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, -274.0, 1e5])
@pytest.mark.parametrize('topic', [TEMPERATURE, COOLANT])
def test_values_that_are_no_temperature(write: Callable[..., Path], topic: str, value: float
                                        ) -> None:
    said = [Said(s.topic, s.stamp, value if (s.topic, s.stamp) == (topic, 7) else s.value)
            for s in loop(20)]
    (episode,), account = read(write(said))
    assert account.dropped == {'not a temperature': 1}
    assert len(episode) == (19 if topic == TEMPERATURE else 20)
    assert np.all(np.isfinite(episode.x))
    if topic == COOLANT:
        # the plant holds the last good one, too
        assert 107.0 not in episode.u
        assert len(episode.u) == 18


def test_measurements_before_the_first_command_are_dropped(write: Callable[..., Path]) -> None:
    (episode,), account = read(write([*measured(*range(1, 16)), *loop(14, 16)]))
    assert stamps(episode)[0] == 16.0
    assert account.lines() == [
        '14 of 29 measurements used', '15 dropped: before the first coolant']


def test_short_stretches_are_dropped(write: Callable[..., Path]) -> None:
    (episode,), account = read(write([*loop(15), *loop(9, 40)]))
    assert len(episode) == 15
    assert account.dropped == {'in a stretch of fewer than 10': 9}


@pytest.mark.parametrize(('said', 'lines'), [
    ([], ['0 of 0 measurements used']),
    (measured(*range(1, 21)), [
        '0 of 20 measurements used', '20 dropped: too short, or without any coolant']),
    (loop(9), ['0 of 9 measurements used', '9 dropped: too short, or without any coolant']),
    ([s for s in loop(20) if s.topic == COOLANT], ['0 of 0 measurements used']),
    # a sensor that does not stamp
    ([Said(s.topic, 0.0, s.value, s.stamp) for s in loop(20)], [
        '0 of 20 measurements used', '19 dropped: measurement with a repeated stamp',
        '1 dropped: too short, or without any coolant']),
])
def test_nothing_to_use(write: Callable[..., Path], said: list[Said], lines: list[str]) -> None:
    episodes, account = read(write(said))
    assert episodes == []
    assert sorted(account.lines()) == sorted(lines)


# Bags.


def test_several_bags(write: Callable[..., Path]) -> None:
    bags = [write(loop(15), 'a.mcap'), write(loop(12, 3), 'b')]
    (first, second), account = read(*bags)
    assert (len(first), len(second)) == (15, 12)
    assert account.lines() == ['27 of 27 measurements used']


def test_bag_that_is_named_twice_is_read_once(write: Callable[..., Path], tmp_path: Path) -> None:
    # else what is learned from were among what is judged by
    bag = write(loop(15))
    (tmp_path / 'link.mcap').symlink_to(bag)
    episodes, account = read(bag, tmp_path / 'link.mcap')
    assert len(episodes) == 1
    assert account.notes == [f'{tmp_path}/link.mcap is named twice: read once']


@pytest.mark.parametrize(('cut', 'left'), [(0, 30), (600, 20)])
def test_bag_that_was_not_closed(write: Callable[..., Path], cut: int, left: int) -> None:
    # flushed after each ten measurements with their answers
    bag = write(loop(30), closed=False)
    content = bag.read_bytes()
    bag.write_bytes(content[:len(content) - cut])
    (episode,), account = read(bag)
    assert len(episode) == left
    assert account.notes == [
        f'{bag} was not closed or is damaged: read up to its last whole record']


def test_damage_in_a_closed_bag_is_told(write: Callable[..., Path]) -> None:
    bag = write(loop(30))
    content = bytearray(bag.read_bytes())
    # within the second of three chunks of ten measurements with their answers
    content[content.index(np.float64(15.0).tobytes())] ^= 1
    bag.write_bytes(content)
    (episode,), account = read(bag)
    assert len(episode) == 10
    assert account.notes == [f'{bag} is damaged: 40 messages that it counts could not be read']


def test_missing_topic_is_named_with_those_there_are(write: Callable[..., Path]) -> None:
    bag = write(loop(15))
    with pytest.raises(BagReadError, match=(
            r"run\.mcap' has no topic '/unit/temperature', it has /coolant_setpoint, "
            '/temperature: name the right topics, or record them')):
        loop_episodes([bag], '/unit/temperature', COOLANT)
    with pytest.raises(BagReadError, match="has no topic '/coolant'"):
        loop_episodes([bag], TEMPERATURE, '/coolant')


def test_wrong_type_and_no_bag(write_bag: Callable[..., Path], tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'other.mcap')
    with pytest.raises(BagReadError, match=(
            r"topic '/clock' of bag .* is rosgraph_msgs/msg/Clock, not sensor_msgs/msg/Temper")):
        loop_episodes([bag], TEMPERATURE, '/clock')
    with pytest.raises(BagReadError, match=r'none\.mcap'):
        loop_episodes([tmp_path / 'none.mcap'], TEMPERATURE, COOLANT)
    (tmp_path / 'empty.mcap').touch()
    with pytest.raises(BagReadError, match=r'empty\.mcap'):
        loop_episodes([tmp_path / 'empty.mcap'], TEMPERATURE, COOLANT)
