# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals as arrays, their jumps, and what acted on which measurement, as read from bags."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
import math
from pathlib import Path

import numpy as np
import pytest

from koopman_ros import records
from koopman_ros.core.datasets import Episode
from koopman_ros.core.message_fields import MessageField
from koopman_ros.plants import one_state_reactor, random_steps, RandomStepDesign
from koopman_ros.records.cutter import spikes_and_jumps
from support.bag_samples import loop_episodes, noted, PRESSURE, Sample, Sent, TEMPERATURE, WALL

MEASURED, COMMAND = '/level', '/valve'
STATE = records.RecordedState('level', 'Pa',
                              MessageField(MEASURED, PRESSURE, 'fluid_pressure', 'Pa'))
INPUT = records.RecordedInput('valve', 'Pa',
                              MessageField(COMMAND, PRESSURE, 'fluid_pressure', 'Pa'))
TEMPERATURES = MessageField('/temperature', TEMPERATURE, 'temperature', 'degC')


def measured(*seconds: float) -> list[Sent]:
    """Return measurements whose value tells their stamp."""
    return [Sent(MEASURED, t, t) for t in seconds]


def loop(count: int, first: int = 1, late: float = 0.0, answer: float = 0.01) -> list[Sent]:
    """Return measurements a second, each with its answer, and when the recorder had them."""
    return [sent for k in range(first, first + count) for sent in (
        Sent(MEASURED, k, float(k), k + late), Sent(COMMAND, k, 100.0 + k, k + answer))]


@pytest.fixture
def write(write_sent: Callable[..., Path]) -> Callable[..., Path]:
    """Return a function that writes pressures to a bag, which the wall clock received."""
    return partial(write_sent, kind=PRESSURE, topics=(MEASURED, COMMAND), log_start_ns=WALL)


def read(*paths: Path) -> tuple[list[Episode], records.ImportReport]:
    episodes, account = loop_episodes(paths, [STATE], [INPUT])
    assert account.used == sum(map(len, episodes))
    return episodes, account


def inputs(episode: Episode) -> list[tuple[float, float]]:
    """Return from when on which input acts, on the scale of the first measurement's value."""
    return list(zip((episode.input_time + episode.x[0, 0]).tolist(), episode.u[:, 0].tolist(),
                    strict=True))


def answers(first: int, last: int, later: float = 0.0) -> list[tuple[float, float]]:
    """Return the inputs of :func:`loop`; the last command acts after the last measurement."""
    return [(later + k, 100.0 + k) for k in range(first, last)]


SPIKE_AND_JUMP = {k: 5000.0 if k == 40 else 3000.0 * (k > 70) for k in range(1, 121)}
SHORT = 'in a segment of fewer than 10'


@pytest.mark.parametrize(('messages', 'values', 'acting', 'dropped', 'note'), [
    pytest.param(loop(20), [range(1, 21)], [answers(1, 20)], {}, (),
                 id='answers act from their stamp on'),
    pytest.param([s for k in range(1, 21)
                  for s in (*measured(k), Sent(COMMAND, k, 25.0 if 8 <= k < 15 else 20.0))],
                 [range(1, 21)], [[(1.0, 20.0), (8.0, 25.0), (15.0, 20.0)]],
                 {}, (), id='an input that stays is one'),
    pytest.param([Sent(COMMAND, 0.5, 20.0), *measured(*range(1, 12)), Sent(COMMAND, 5.25, 30.0),
                  Sent(COMMAND, 5.75, 10.0)],
                 [range(1, 12)], [[(0.5, 20.0), (5.25, 30.0), (5.75, 10.0)]],
                 {}, (), id='commands between measurements'),
    pytest.param([*loop(5), Sent(COMMAND, 5.0, 77.0, 5.2), *loop(7, 6)], [range(1, 13)],
                 [[*answers(1, 5), (5.0, 77.0), *answers(6, 12)]],
                 {}, (), id='the last word for a measurement counts'),
    pytest.param([*loop(15), *loop(12, 40)], [range(1, 16), range(40, 52)],
                 [answers(1, 15), answers(40, 51)],
                 {}, ('gap', '25.000 s', '15.000 s'), id='gap'),
    pytest.param([*loop(15), *loop(9, 40)], [range(1, 16)], [answers(1, 15)],
                 {'in a segment of fewer than 10': 9}, ('gap', '25.000 s', '15.000 s'),
                 id='short segment'),
    pytest.param([s for s in loop(20) if (s.topic, s.stamp) not in [(MEASURED, 7), (MEASURED, 8)]],
                 [[*range(1, 7), *range(9, 21)]], [answers(1, 20)],
                 {}, (), id='a few lost samples are no gap'),
    pytest.param([Sent(COMMAND, 0.5, 20.0), *measured(*range(1, 13)), *measured(*range(60, 72))],
                 [range(1, 13), range(60, 72)], [[(0.5, 20.0)]] * 2,
                 {}, ('gap', '48.000 s', '12.000 s'), id='a command is held over a gap'),
    pytest.param([replace(s, value=s.value + SPIKE_AND_JUMP[s.stamp]) if s.topic == MEASURED else s
                  for s in loop(120)],
                 [[*range(1, 40), *range(41, 71)], range(3071, 3121)],
                 [answers(1, 70), answers(71, 120, 3000.0)],
                 {'spike (level)': 1}, ('jump', '3071 Pa', '70.000 s'),
                 id='spike and jump'),
    pytest.param([*loop(30), *(Sent(s.topic, s.stamp, s.value + 500.0, s.received + 100.0)
                               for s in loop(12))],
                 # what acted before is not what acts now
                 [range(1, 31), range(501, 513)],
                 [answers(1, 30), [(500.0 + k, 600.0 + k) for k in range(1, 12)]],
                 {}, ('time was set back', '29.000 s'), id='time set back'),
    # 5.5 s arrives after 6 s; 9 s comes twice, with another value
    pytest.param([*loop(6), Sent(MEASURED, 5.5, 5.5, 6.2), *loop(3, 7),
                  Sent(MEASURED, 9.0, 999.0, 9.9), *loop(11, 10)],
                 [[*range(1, 6), 5.5, *range(6, 21)]], [answers(1, 20)],
                 {'measurement with a repeated stamp': 1}, (), id='late and repeated stamps'),
    pytest.param([*measured(*range(1, 16)), *loop(14, 16)], [range(16, 30)], [answers(16, 29)],
                 {'before the first input': 15}, (), id='measurements before the first command'),
    pytest.param([], [], [], {}, (), id='nothing'),
    pytest.param(measured(*range(1, 21)), [], [],
                 {'without any input': 20}, (), id='no command'),
    pytest.param(loop(9), [], [], {SHORT: 9}, (), id='too short'),
    pytest.param([s for s in loop(20) if s.topic == COMMAND], [], [],
                 {}, (), id='no measurement'),
    pytest.param([Sent(s.topic, 0.0, s.value, s.stamp) for s in loop(20)], [], [],
                 {SHORT: 1, 'measurement with a repeated stamp': 19}, (),
                 id='a sensor that does not stamp'),
])
def test_episodes_of_a_bag(
    write: Callable[..., Path], messages: list[Sent], values: list[Iterable[float]],
    acting: list[list[tuple[float, float]]], dropped: dict[str, int], note: tuple[str, ...]
) -> None:
    episodes, account = read(write(messages))
    # values tell the stamps
    assert [episode.x[:, 0].tolist() for episode in episodes] == [list(one) for one in values]
    for episode in episodes:
        np.testing.assert_allclose(episode.time, episode.x[:, 0] - episode.x[0, 0], atol=1e-12)
    assert [inputs(episode) for episode in episodes] == acting
    assert account.dropped == dropped
    assert account.measurements == account.used + sum(dropped.values())
    assert noted(account, *note) if note else not account.notes


def test_wall_clock_answers_act_when_they_arrive(write: Callable[..., Path]) -> None:
    # 120 ms later than its measurement, by the recorder's clock
    messages = loop(20, late=0.02, answer=0.14)
    (episode,), _ = read(write(messages, wall=True))
    # the first measurement was taken before any command
    assert episode.x[:, 0].tolist() == list(range(2, 21))
    assert [t for t, _ in inputs(episode)[:3]] == pytest.approx([1.12, 2.12, 3.12])
    # one stray receipt does not hide the wall clock
    messages[-2] = replace(messages[-2], received=29.0)
    (episode,), _ = read(write(sorted(messages, key=lambda s: s.received), 'stray', wall=True))
    assert inputs(episode)[0][0] == pytest.approx(1.12)
    # a short delay counts as none
    (episode,), _ = read(write(loop(20, late=0.02, answer=0.025), 'short', wall=True))
    assert [t for t, _ in inputs(episode)] == list(range(1, 20))


def test_dead_time_of_the_actuator(write: Callable[..., Path]) -> None:
    (episode,), account = loop_episodes(
        [write(loop(20))], [STATE], [replace(INPUT, delay=2.000000001)])
    # to the nanosecond, from the first measurement on, at 4 s
    assert episode.input_time[:3].tolist() == [1e-9 - 1.0, 1e-9, 1e-9 + 1.0]
    assert episode.u[:3, 0].tolist() == [101.0, 102.0, 103.0]
    # nobody knows what acted before
    assert episode.x[0, 0] == 4.0
    assert account.dropped == {'before the first input': 3}


@pytest.mark.parametrize('wall', [True, False])
def test_commands_without_a_stamp_act_when_received(write: Callable[..., Path], wall: bool
                                                    ) -> None:
    # where stamps are simulated the plant runs ten times as fast as the recorder's clock
    pace = 1.0 if wall else 0.1
    messages = [Sent(MEASURED, k, float(k), k * pace) for k in range(1, 31)]
    messages += [Sent(COMMAND, 0.0, 20.0, 1.5 * pace), Sent(COMMAND, 0.0, 25.0, 12.25 * pace)]
    messages.sort(key=lambda s: s.received or 0.0)
    (episode,), account = read(write(messages, wall=wall))
    # the clocks' nanoseconds since 1970 are told apart to some hundred
    assert [t for t, _ in inputs(episode)] == pytest.approx([1.5, 12.25], abs=1e-5)
    assert (account.used, account.dropped) == (29, {'before the first input': 1})


def test_a_repeated_finding_is_reported_once(write: Callable[..., Path]) -> None:
    set_back = [part for k in range(500) for part in (
        Sent(MEASURED, 10.0 + 0.01 * k, 20.0, float(k)), Sent(COMMAND, 5.0, 20.0, float(k)),
        Sent(MEASURED, 5.0, 20.0, k + 0.5))]
    gaps = [Sent(topic, 100.0 + 40.0 * k + (k > 6) + t, 20.0, 5000.0 + 40.0 * k + t)
            for k in range(9) for t in range(12) for topic in (COMMAND, MEASURED)]
    episodes, account = read(write([*set_back, *gaps]))
    assert len(episodes) == 9
    back, gap = account.notes
    assert all(words in back for words in ('set back', '5.000 s', '500', '9.990 s'))
    assert all(words in gap for words in ('gap', '95.000 s at 5.000 s', 'of 9'))


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, -1e13])
@pytest.mark.parametrize('topic', [MEASURED, COMMAND])
def test_values_that_are_no_measurement(write: Callable[..., Path], topic: str, value: float
                                        ) -> None:
    messages = [Sent(s.topic, s.stamp, value if (s.topic, s.stamp) == (topic, 7) else s.value)
                for s in loop(20)]
    (episode,), account = read(write(messages))
    assert account.dropped == {'outside -1e+12 to 1e+12 Pa': 1}
    assert len(episode) == (19 if topic == MEASURED else 20)
    assert np.all(np.isfinite(episode.x))
    if topic == COMMAND:
        # the plant holds the last good one, too
        assert 107.0 not in episode.u
        assert len(episode.u) == 18


def test_each_of_several_bags_is_read_once(write: Callable[..., Path], tmp_path: Path) -> None:
    # a bag named twice would put the same episodes into training and test
    bags = write(loop(15), 'a.mcap'), write(loop(12, 3), 'b')
    (tmp_path / 'link.mcap').symlink_to(bags[0])
    (first, second), account = read(*bags, tmp_path / 'link.mcap')
    assert (len(first), len(second)) == (15, 12)
    assert account.lines()[0] == '27 of 27 values used'
    assert noted(account, 'link.mcap', 'twice')


def test_damage_in_a_closed_bag_is_reported(write: Callable[..., Path]) -> None:
    bag = write(loop(30))
    content = bytearray(bag.read_bytes())
    # within the second of three chunks of ten measurements with their answers
    content[content.index(np.float64(15.0).tobytes())] ^= 1
    bag.write_bytes(content)
    (episode,), account = read(bag)
    assert len(episode) == 10
    assert noted(account, 'damaged', '40 of its messages')


def test_topics_that_are_not_there(write: Callable[..., Path], tmp_path: Path) -> None:
    bag = write(loop(15))
    (tmp_path / 'empty.mcap').touch()
    other = replace(INPUT, command=replace(INPUT.command, topic='/unit/level'))
    for path, signal, words in (
            (bag, other, "has no topic '/unit/level'"),
            (bag, replace(INPUT, command=replace(INPUT.command, type='std_msgs/msg/Float64')),
             r"'/valve' of bag .* is sensor_msgs/msg/FluidPressure, not std_msgs/msg/Float64"),
            (bag, replace(INPUT, unit='K'), r"'/valve' of bag .*: 'Pa' cannot be converted to 'K'"
             '.*; name another topic'),
            (tmp_path / 'none.mcap', INPUT, r'none\.mcap'),
            (tmp_path / 'empty.mcap', INPUT, r'empty\.mcap')):
        with pytest.raises(records.BagReadError, match=words):
            loop_episodes([path], [STATE], [signal])
    with pytest.raises(records.BagReadError,
                       match="has no topic '/valve_2'"):
        records.read_series(bag, replace(INPUT.command, topic='/valve_2'))


def test_episodes_are_converted_to_the_requested_units(write: Callable[..., Path]) -> None:
    (episode,), _ = loop_episodes(
        [write(loop(15))], [replace(STATE, unit='kPa')], [replace(INPUT, unit='mbar')])
    assert episode.x[0, 0] == pytest.approx(0.001)
    assert episode.u[0, 0] == pytest.approx(1.01)


# Signals as arrays.


def test_signal_as_arrays(
    tmp_path: Path, write_bag: Callable[..., Path], samples: list[Sample]
) -> None:
    bag = write_bag(tmp_path / 'run')
    sent = [sample for sample in samples if sample.topic == '/temperature']
    series = records.read_series(bag, TEMPERATURES)
    np.testing.assert_array_equal(series.stamp_ns, [one.publish_time_ns for one in sent])
    np.testing.assert_array_equal(series.values, [one.message.temperature for one in sent])
    assert series.unit == 'degC'
    with pytest.raises(records.BagReadError, match=(
            r"'/joint_states' .* is sensor_msgs/msg/JointState, not sensor_msgs/msg/Temperature")):
        records.read_series(bag, replace(TEMPERATURES, topic='/joint_states'))
    file = bag / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(records.BagReadError, match='was not closed'):
        records.read_series(file, TEMPERATURES)
    assert len(records.read_series(file, TEMPERATURES, recover=True).values) == len(sent)


def test_topic_without_messages_gives_empty_arrays(write: Callable[..., Path]) -> None:
    series = records.read_series(write([]), STATE.place)
    assert series.stamp_ns.shape == series.values.shape == (0,)
    assert series.stamp_ns.dtype == np.int64


@pytest.mark.parametrize(('field', 'other'), [
    ('float64 temperature', 'float64 heat'),
    ('float64 temperature', 'string temperature'),
    ('std_msgs/Header header', 'builtin_interfaces/Time header'),
])
def test_type_that_only_bears_the_name(
    tmp_path: Path, samples: list[Sample], field: str, other: str
) -> None:
    known = records.message_definition('sensor_msgs/msg/Temperature')
    sample = next(s for s in samples if s.topic == '/temperature')
    text = known.text.replace(field, other)
    assert text != known.text
    with records.BagWriter(tmp_path / 'run.mcap') as writer:
        writer.add_topic('/t', replace(known, text=text))
        writer.write('/t', sample.data, 1)
    place = replace(TEMPERATURES, topic='/t')
    for read in (lambda: records.read_series(writer.path, place),
                 lambda: loop_episodes(
                     [writer.path], [records.RecordedState('x', 'K', place)],
                     [records.RecordedInput('u', 'K', place)])):
        with pytest.raises(records.BagReadError, match=r'different definition|cannot be decoded'):
            read()


# Spikes and jumps.

DESIGN = RandomStepDesign(281.33, 300.55, 305.0, 327.0, (0.5, 2.0), 1.0 / 60.0, rtol=1e-9)


@pytest.fixture(scope='module')
def motion() -> np.ndarray:
    """Return twenty minutes of the reactor under random steps, a sample a second [degC]."""
    return random_steps(one_state_reactor(), DESIGN, 20.0, 5).x[:, 0] - 273.15


def found(values: np.ndarray) -> list[list[int]]:
    """Return where there are spikes, and where jumps."""
    return [np.flatnonzero(kind).tolist() for kind in spikes_and_jumps(values, 1.0)]


@pytest.mark.parametrize('noise', [0.0, 0.1, 1.0])
def test_motion_under_steps_is_neither(motion: np.ndarray, noise: float) -> None:
    for stride in (1, 10, 30):
        values = motion[::stride]
        values = values + noise * np.random.default_rng(1).standard_normal(len(values))
        assert found(values) == [[], []]


@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_spikes_and_jumps_are_found(motion: np.ndarray, noise: float) -> None:
    values = motion + noise * np.random.default_rng(2).standard_normal(len(motion))
    values[[100, 700]] += [40.0, -35.0]
    values[900:] += 30.0
    assert found(values) == [[100, 700], [900]]


@pytest.mark.parametrize(('values', 'jumps'), [
    # a step of the input after a long rest
    (51.0 - 10.0 * (1.0 - np.exp(-np.maximum(np.arange(3000.0) - 2950.0, 0.0) / 25.0)), []),
    # a reset while all rests, and one that is too small
    (np.r_[np.full(200, 40.0), np.full(200, 51.0)], [200]),
    (np.r_[np.full(200, 40.0), np.full(200, 40.9)], []),
    # few samples tell nothing
    (np.r_[np.zeros(20), 100.0, np.zeros(20)], [])])
def test_jumps_after_a_rest(values: np.ndarray, jumps: list[int]) -> None:
    assert found(values) == [[], jumps]


@pytest.mark.parametrize('share', [0.01, 0.055, 0.1, 0.15])
def test_spikes_are_found_whatever_their_share(share: float) -> None:
    rng = np.random.default_rng(5)
    values = 50.0 + 20.0 * np.sin(np.arange(600) / 30.0)
    # also the first and the last sample, which have neighbours on one side
    spiked = np.unique([0, 599, *rng.choice(600, round(600 * share), replace=False).tolist()])
    values[spiked] += rng.choice([60.0, 45.0], len(spiked))
    assert found(values) == [spiked.tolist(), []]


def test_spikes_on_ramps_are_found() -> None:
    goal = np.repeat(np.random.default_rng(1).uniform(20.0, 90.0, 20), 30)
    values = [20.0]
    for one in goal[:-1]:
        values.append(values[-1] + 0.08 * (one - values[-1]))
    spiked = np.arange(2, 600, 31)
    leaping = np.array(values)
    leaping[spiked] += 40.0
    assert found(np.array(values)) == [[], []]
    assert found(leaping) == [spiked.tolist(), []]


@pytest.mark.parametrize('step', [0.5, 1.0])
def test_a_coarse_sensor_neither_jumps_nor_has_spikes(step: float) -> None:
    # a slow room within 3 K
    rng = np.random.default_rng(1)
    heater, values = np.repeat(rng.uniform(19.0, 23.0, 12), 240), [20.0]
    for goal in heater[:-1]:
        values.append(values[-1] + (goal - values[-1]) / 120.0)
    coarse = step * np.round(np.array(values) / step)
    assert [np.flatnonzero(kind).tolist() for kind in spikes_and_jumps(coarse)] == [[], []]
    coarse[[500, 1500]] += 40.0
    coarse[2000:] += 30.0
    assert [np.flatnonzero(kind).tolist() for kind in spikes_and_jumps(coarse)] == [
        [500, 1500], [2000]]


def test_many_spikes_are_a_warning() -> None:
    level = 50.0 + 20.0 * np.sin(np.arange(600) / 30.0)
    for count, warned in ((6, False), (30, True)):
        spiked = level.copy()
        spiked[5::600 // count] += 60.0
        record = records.read({'level': spiked, 'valve': level}, 'level', 'valve', period=1.0)
        assert record.report.dropped == {'spike (level)': count}
        assert bool(record.report.warnings()) == warned == ('warning' in str(record))
