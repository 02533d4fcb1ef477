# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of the loop: the figures it leaves, from real processes."""

import pytest

from validation.benchmarks.loop import part, step, table
from validation.benchmarks.loop.naive import NaiveLaw

PLAN = part.Plan(coordinates=(2, 4), steps=60, rounds=1, rate_seconds=0.1, lowest_rate=400.0,
                 starts=1, plant_seconds=50.0)


def test_every_figure_is_there_and_explained(run):
    figures, _ = run
    assert set(part.MEANING) <= set(figures)
    assert set(figures['step_us']) == set(figures['step_ratio_to_naive']) == {'2', '4'}
    assert set(figures['rss_megabytes']) == {'plant', 'controller', 'trainer', 'echo'}


def test_both_laws_give_the_same_commands(run):
    figures, _ = run
    for n_z, one in figures['step'].items():
        assert one['steps'] == 60
        assert one['largest_difference_kelvin'] < 1e-9
        assert 0.0 < one['median_us'] <= one['p99_us']
        assert 0.0 < one['naive_median_us'] <= one['naive_p99_us']
        assert figures['step_ratio_to_naive'][n_z] == pytest.approx(
            one['naive_cpu_median_us'] / one['cpu_median_us'])


def test_laws_that_differ_are_not_compared(monkeypatch):
    same = NaiveLaw.step
    monkeypatch.setattr(NaiveLaw, 'step', lambda self, *given: same(self, *given) + 2e-6)
    with pytest.raises(ValueError, match='differ by 2e-06 K'):
        step.compare(3, 5)


def test_latency_stands_beside_the_echo(run):
    figures, _ = run
    latency = figures['latency']
    assert latency['measurements'] == 50
    for quantile in ('median', 'p99'):
        ours, echo = (latency[side][f'{quantile}_us'] for side in ('controller', 'echo'))
        assert figures[f'latency_ratio_{quantile}'] == pytest.approx(ours / echo)
        assert min(ours, echo) > 0.0


def test_highest_rate_is_the_last_that_was_kept_up(run):
    figures, _ = run
    steps = figures['rate']['steps']
    kept_up = [one['sent_hz'] for one in steps if one['kept_up']]
    assert figures['max_rate_hz'] == (kept_up[-1] if kept_up else None)
    assert figures['rate']['ended_by']
    for one in steps:
        assert one['sent'] == round(0.1 * one['rate_hz'])
        assert not (one['kept_up'] and one['unanswered'])


def test_lockstep_runs_to_its_end(run):
    figures, _ = run
    lockstep = figures['lockstep']
    assert figures['speedup_over_real_time'] == pytest.approx(50.0 / lockstep['seconds'])
    assert figures['startup_seconds'] > 0.0
    assert min(figures['rss_megabytes'].values()) > 10.0


def test_figures_are_saved_on_the_way(run):
    _, saved = run
    assert [('step_us' in keys, 'latency' in keys, 'max_rate_hz' in keys) for keys in saved] == [
        (True, False, False), (True, True, False), (True, True, True)]


def test_table_holds_the_figures(run):
    figures, _ = run
    text = '\n'.join([*table.of_step(figures), *table.of_latency(figures),
                      *table.of_rate(figures), *table.of_nodes(figures)])
    assert f'n_z = 4{figures["step_ratio_to_naive"]["4"]:14.1f}x' in text
    assert f'{figures["latency_ratio_median"]:8.2f}' in text
    assert f'first command {figures["startup_seconds"]:.2f} s' in text
