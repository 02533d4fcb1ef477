# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Episodes of several states and inputs: put together by stamp, in units, inputs as measured."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from koopman_ros import records
from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.records import RecordedInput, RecordedState
from koopman_ros.records.applied_inputs import follows_command
from support.bag_samples import FLOAT, JOINTS, loop_episodes, noted, Sent, TEMPERATURE

WARM = RecordedState('warm', 'K', MessageField('/warm', TEMPERATURE, 'temperature', 'degC'))
COLD = RecordedState('cold', 'K', MessageField('/cold', TEMPERATURE, 'temperature', 'degC'))
TANKS = [RecordedState(name, 'm', MessageField('/tanks', JOINTS, f'position[{name}]', 'mm'))
         for name in ('low', 'high')]
PUMP = RecordedInput('pump', 'm^3/s', MessageField('/pump_setpoint', FLOAT, 'data', 'L/s'))
JACKET = RecordedInput(
    'jacket', 'K', MessageField('/jacket_setpoint', TEMPERATURE, 'temperature', 'degC'),
    MessageField('/jacket', TEMPERATURE, 'temperature', 'degC'))
COMMANDED = replace(JACKET, measured=None)


@pytest.fixture
def write(write_sent: Callable[..., Path]) -> Callable[..., Path]:
    return write_sent


def jacket(*values: float) -> list[Sent]:
    return [Sent('/jacket_setpoint', k, value) for k, value in enumerate(values, 1)]


@pytest.mark.parametrize(('values', 'linear', 'acting'), [
    ([20.0] * 5 + [30.0] * 10, (), [20.0, 20.0, 30.0]),
    (list(20.0 + np.arange(15)), (True,), [20.0, 20.5, 25.0])])
def test_an_input_without_commands_is_taken_from_its_measurements(
    write: Callable[..., Path], values: list[float], linear: tuple[bool, ...], acting: list[float]
) -> None:
    path = write([s for k, value in enumerate(values, 1) for s in (
        Sent('/warm', k, 50.0 + k), Sent('/jacket', k, value))])
    (episode,), account = loop_episodes([path], [WARM], [JACKET])
    assert (len(episode), episode.linear) == (15, linear)
    assert episode.inputs_at(np.array([0.0, 0.5, 5.0]))[:, 0] == pytest.approx(
        273.15 + np.array(acting))
    assert "no topic '/jacket_setpoint': jacket is taken from its measurements" in account.notes[0]
    # the same by names alone
    assert np.array_equal(records.read(path, 'warm [K]', 'jacket [K]').episodes[0].u, episode.u)
    with pytest.raises(ValueError, match='warm has no unit, and a bag stores none'):
        records.read(path, 'warm', 'jacket [K]')


def test_an_input_without_commands_that_is_not_measured_throughout(write: Callable[..., Path]
                                                                   ) -> None:
    path = write([*(Sent('/warm', k, 50.0 + k) for k in range(1, 31)),
                  *(Sent('/jacket', k, 20.0) for k in range(1, 16))])
    episodes, account = loop_episodes([path], [WARM], [JACKET])
    assert not episodes
    assert 'jacket was not always measured, and has no commands' in account.notes[-1]


def test_fields_of_one_message_in_the_units_of_the_signals(write: Callable[..., Path]) -> None:
    path = write([s for k in range(1, 16) for s in (
        # the order of the names changes, as joint states may
        Sent('/tanks', k, dict(sorted({'low': 10.0 * k, 'high': 500.0 + k}.items(),
                                      reverse=k % 2 == 0))),
        Sent('/pump_setpoint', None, 2.0 + (k > 5), k))])
    (episode,), account = loop_episodes([path], TANKS, [PUMP])
    assert episode.x == pytest.approx(np.column_stack(
        [0.01 * np.arange(1, 16), 0.5 + 0.001 * np.arange(1, 16)]), rel=1e-12)
    assert episode.u[:, 0] == pytest.approx([0.002, 0.003])
    assert episode.input_time.tolist() == [0.0, 5.0]
    assert (account.measurements, account.used) == (30, 30)
    assert noted(account, '/pump_setpoint', 'no stamp')


def test_message_without_an_element_is_counted(write: Callable[..., Path]) -> None:
    path = write([s for k in range(1, 16) for s in (
        Sent('/tanks', k, {'low': 1.0, **({} if k == 4 else {'high': 2.0})}), *jacket(1.0))])
    (episode,), account = loop_episodes([path], TANKS, [COMMANDED])
    assert len(episode) == 14
    assert account.dropped == {'without position[high]': 1, 'measurement without high': 1}
    assert (account.measurements, account.used) == (30, 28)


@pytest.mark.parametrize(('tolerance', 'shift', 'left', 'dropped'), [
    (0.0, 0.0, 20, {}),
    (0.05, 0.04, 20, {}),
    (0.05, -0.04, 20, {}),
    (0.05, 0.06, 0, {'measurement with cold more than 0.05 s apart': 20,
                     'measurement with warm more than 0.05 s apart': 20}),
])
def test_signals_of_several_topics_are_put_together_by_stamp(
    write: Callable[..., Path], tolerance: float, shift: float, left: int,
    dropped: dict[str, int]
) -> None:
    path = write([*jacket(1.0), *(s for k in range(1, 21) for s in (
        Sent('/warm', k, 50.0 + k), Sent('/cold', k + shift, 10.0 - k)))])
    episodes, account = loop_episodes([path], [WARM, COLD], [COMMANDED],
                                              tolerance_ns=round(tolerance * SECOND))
    assert sum(map(len, episodes)) == left
    assert account.dropped == dropped
    assert account.measurements == account.used + sum(account.dropped.values()) == 40
    for episode in episodes:
        assert episode.x.sum(axis=1) == pytest.approx(np.full(left, 60.0 + 2 * 273.15))
        # the stamps of the first
        assert episode.time.tolist() == list(range(20))


def test_missing_and_doubled_parts_are_named(write: Callable[..., Path]) -> None:
    sent = [*jacket(1.0), *(s for k in range(1, 21) for s in (
        Sent('/warm', k, 50.0 + k), *([] if k in (3, 8) else [Sent('/cold', k, 10.0)])))]
    sent += [Sent('/warm', 5.0, 99.0, 5.5), Sent('/warm', 12.01, 77.0, 12.01)]
    path = write(sorted(sent, key=lambda s: s.received or s.stamp))
    (episode,), account = loop_episodes([path], [WARM, COLD], [COMMANDED],
                                                tolerance_ns=SECOND // 20)
    assert (episode.x[:, 0] - 323.15).round(9).tolist() == [
        k for k in range(1, 21) if k not in (3, 8)]
    assert account.dropped == {
        'measurement without cold': 2, 'one of several within 0.05 s (warm)': 1,
        'measurement with a repeated stamp (warm)': 1}
    assert (account.measurements, account.used) == (40, 36)


def test_spikes_and_jumps_of_each_state(write: Callable[..., Path]) -> None:
    path = write([*jacket(1.0), *(s for k in range(1, 121) for s in (
        Sent('/warm', k, 50.0 + 0.1 * k + 30.0 * (k == 40)),
        Sent('/cold', k, 10.0 + 0.1 * k + 25.0 * (k > 70))))])
    recorded = [path], [WARM, COLD], [COMMANDED]
    episodes, account = loop_episodes(*recorded)
    # the other state was measured when one has a spike
    assert [len(episode) for episode in episodes] == [70, 50]
    assert account.dropped == {'spike (warm)': 1}
    assert noted(account, 'jump', '42.1 degC', 'cold', '70.000 s')
    # a change of 25 K may not be one
    (episode,), _ = loop_episodes(*recorded, least_jumps=[1.0, 26.0])
    assert len(episode) == 120


@pytest.mark.parametrize(('least', 'count'), [(0.024, 2), (0.026, 1)])
def test_the_smallest_jump_is_in_the_unit_of_the_signal(
        write: Callable[..., Path], least: float, count: int) -> None:
    """Levels in m, whose messages are in mm, one of which changes by 25 mm."""
    path = write([s for k in range(1, 121) for s in (
        Sent('/tanks', k, {'low': 100.0 + 0.1 * k, 'high': 500.0 + 0.1 * k + 25.0 * (k > 70)}),
        Sent('/pump_setpoint', None, 2.0, k))])
    episodes, _ = loop_episodes([path], TANKS, [PUMP], least_jumps=[least] * 2)
    assert len(episodes) == count


def test_states_without_stamps_are_put_together_by_default(write: Callable[..., Path]) -> None:
    """Within half the interval between two measurements."""
    level = RecordedState('level', 'm', MessageField('/level', FLOAT, 'data', 'm'))
    flow = RecordedState('flow', 'm', MessageField('/flow', FLOAT, 'data', 'm'))
    path = write([*jacket(*[20.0] * 20), *(s for k in range(1, 21) for s in (
        Sent('/level', None, 1.0 + 0.01 * k, k), Sent('/flow', None, 2.0 + 0.01 * k, k + 0.3)))])
    (episode,), account = loop_episodes([path], [level, flow], [COMMANDED])
    assert len(episode) == 20
    assert (episode.x[:, 1] - episode.x[:, 0]).tolist() == pytest.approx([1.0] * 20)
    assert 'no stamp' in ''.join(account.notes)


def test_states_without_a_stamp_count_at_their_receipt(write: Callable[..., Path]) -> None:
    level = RecordedState('level', 'm', MessageField('/level', FLOAT, 'data', 'm'))
    # the stamps are simulated, ten times as fast as the recorder's clock
    path = write([Sent('/jacket_setpoint', 1, 1.0, 100.05), *(s for k in range(1, 21) for s in (
        Sent('/warm', k, 50.0 + k, 100.0 + 0.1 * k),
        Sent('/level', None, float(k), 100.001 + 0.1 * k)))])
    (episode,), account = loop_episodes(
        [path], [WARM, level], [COMMANDED], tolerance_ns=SECOND // 50)
    assert episode.x[:, 1].tolist() == list(range(1, 21))
    assert episode.time.tolist() == list(range(20))
    assert noted(account, '/level', 'no stamp')


# Inputs as they were measured.


def lagging(times: np.ndarray, lag: float) -> np.ndarray:
    """Return an input that has followed steps from 20 to 30 at 5.5 s and to 10 at 15 s."""
    def rise(at: float) -> np.ndarray:
        return np.where(times > at, 1.0 - np.exp(-np.maximum(times - at, 0.0) / lag), 0.0)
    return 20.0 + 10.0 * rise(5.5) - 20.0 * rise(15.0)


def jacket_run(measured: np.ndarray) -> list[Sent]:
    """Return a run of 30 s under those commands, with the input as it was measured."""
    commands = ((1.0, 20.0), (5.5, 30.0), (15.0, 10.0))
    return sorted([*(Sent('/jacket_setpoint', t, u) for t, u in commands), *(
        s for k, u in enumerate(measured.tolist(), 1) for s in (
            Sent('/warm', float(k), 50.0 + k), Sent('/jacket', float(k), u)))],
        key=lambda s: s.stamp or 0.0)


def test_input_behind_a_lag_is_linear_between_its_measurements(write: Callable[..., Path]) -> None:
    times = np.arange(1.0, 31.0)
    u = lagging(times, 4.0)
    path = write(jacket_run(u))
    (episode,), account = loop_episodes([path], [WARM], [JACKET])
    assert episode.linear == (True,)
    assert episode.u[:, 0] == pytest.approx(u + 273.15)
    assert episode.input_time.tolist() == episode.time.tolist()
    area = np.concatenate(([0.0], np.cumsum(0.5 * (u[1:] + u[:-1] + 2 * 273.15))))
    assert episode.input_integral(episode.time)[:, 0] == pytest.approx(area)
    assert noted(account, 'jacket', 'measured')


@pytest.mark.parametrize(('lag', 'ceiling', 'noise', 'values'), [
    (1e-3, 99.0, 0.0, [20.0, 30.0, 10.0]),
    # a sensor of it may be noisy
    (1e-3, 99.0, 0.05, [20.0, 30.0, 10.0]),
    # and the actuator at its end
    (1e-3, 24.0, 0.0, [20.0, 24.0, 10.0]),
])
def test_input_that_follows_at_once_changes_with_its_command(
    write: Callable[..., Path], lag: float, ceiling: float, noise: float, values: list[float]
) -> None:
    times = np.arange(1.0, 31.0)
    u = np.minimum(lagging(times, lag), ceiling)
    path = write(jacket_run(u + noise * np.random.default_rng(0).standard_normal(30)))
    (episode,), account = loop_episodes([path], [WARM], [JACKET])
    assert (episode.linear, account.notes) == ((), [])
    assert episode.u[:, 0] == pytest.approx(np.array(values) + 273.15)
    # to the time, which no measurement tells
    assert episode.input_time.tolist() == [0.0, 4.5, 14.0]


def test_input_that_is_measured_at_a_change_shows_it_before_or_after() -> None:
    times, held = SECOND * np.arange(6), np.array([1.0, 2.0, 1.0, 3.0, 2.0, 5.0])
    assert [follows_command(times, held, times[1:], measured) for measured in (
        held[:-1], held[1:], held[1:] + 1.5)] == [True, True, False]


def test_input_that_was_measured_in_part_is_taken_from_its_command(write: Callable[..., Path]
                                                                   ) -> None:
    u = lagging(np.arange(1.0, 31.0), 4.0)
    run = jacket_run(u)
    path = write([s for s in run if s.topic != '/jacket' or not 10 < (s.stamp or 0) < 20])
    (episode,), account = loop_episodes([path], [WARM], [JACKET])
    assert episode.linear == ()
    assert episode.u[:, 0] == pytest.approx(np.array([293.15, 303.15, 283.15]))
    assert noted(account, 'jacket', 'not always measured')
    path.unlink()
    write([s for s in run if s.topic != '/jacket'])
    (again,), account = loop_episodes([path], [WARM], [JACKET])
    assert np.array_equal(again.u, episode.u)
    assert noted(account, "no topic '/jacket'")


def test_one_input_measured_and_one_commanded(write: Callable[..., Path]) -> None:
    u = lagging(np.arange(1.0, 31.0), 4.0)
    path = write(sorted([*jacket_run(u), *(Sent('/pump_setpoint', None, q, t) for t, q in (
        (0.5, 1.0), (7.25, 2.0)))], key=lambda s: s.stamp or s.received or 0.0))
    (episode,), _ = loop_episodes([path], [WARM], [JACKET, PUMP])
    assert episode.linear == (True, False)
    # 1 L/s for 6.25 s, then 2 L/s
    assert episode.input_integral(np.array([10.0]))[0, 1] == pytest.approx(0.001 * (6.25 + 7.5))
    between = episode.inputs_at(np.array([6.25]))[0]
    assert between == pytest.approx([273.15 + 0.75 * u[6] + 0.25 * u[7], 0.002])
