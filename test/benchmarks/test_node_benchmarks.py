# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmarks of loop and recording: the figures they leave, from real processes."""

import json
import warnings

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from benchmarks import growth, loop, planning, recording, step
from benchmarks.__main__ import main


@pytest.fixture(scope='module')
def figures(tmp_path_factory):
    """Return what a short run of both parts leaves beside the figures of another one."""
    folder = tmp_path_factory.mktemp('bench')
    (folder / 'summary.json').write_text('{"training": {"kept": true}}')
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
        warnings.simplefilter('error')
        patch.setitem(loop.PLANS, 'quick', loop.Plan(
            (2, 4), 60, 1, 0.05, 800.0, 1, 50.0, 12, False))
        patch.setattr(planning, 'SETPOINTS', {'pendulum': planning.SETPOINTS['pendulum']})
        patch.setitem(recording.PLANS, 'quick', recording.Plan(1.0, (500.0, 2000.0), 0.5, 3000, 1))
        assert main(['recording', 'loop', '--quick', '--output', str(folder)]) == 0
    # of the loop alone
    assert (folder / growth.FILE).read_bytes().startswith(b'\x89PNG')
    return json.loads((folder / 'summary.json').read_text())


def test_the_parts_leave_the_figures_of_the_other_one(figures):
    assert figures['training'] == {'kept': True}
    assert set(loop.MEANING) <= set(figures['loop'])


def test_both_laws_give_the_same_commands(figures):
    found = figures['loop']
    assert set(found['step_us']) == set(found['step_ratio_to_naive']) == {'2', '4'}
    for n_z, one in found['step'].items():
        assert one['steps'] == 60
        assert one['largest_difference_kelvin'] < 1e-9
        assert 0.0 < one['median_us'] <= one['p99_us']
        assert 0.0 < one['naive_median_us'] <= one['naive_p99_us']
        assert found['step_ratio_to_naive'][n_z] == pytest.approx(
            one['naive_cpu_median_us'] / one['cpu_median_us'])


def test_plans_stand_beside_those_of_other_programs(figures):
    found = figures['loop']
    (plant, one), = found['plan'].items()
    assert plant == 'pendulum'
    assert found['plan_us'][plant]['median'] == one['law_cpu_median_us']
    for side in ('do_mpc', 'sqp'):
        assert one['agreement'][side] < planning.TOLERANCE[side]
        for quantile in ('median', 'p99'):
            assert found[f'plan_ratio_to_{side}'][plant][quantile] == pytest.approx(
                one[f'{side}_cpu_{quantile}_us'] / one[f'law_cpu_{quantile}_us'])


def test_laws_that_differ_are_not_compared(monkeypatch):
    same = step.NaiveLaw.step
    monkeypatch.setattr(step.NaiveLaw, 'step', lambda self, *given: same(self, *given) + 2e-6)
    with pytest.raises(ValueError, match='differ by 2e-06 K'):
        step.compare(3, 5)


def test_the_loop_across_processes(figures):
    found = figures['loop']
    latency, steps = found['latency'], found['rate']['steps']
    assert latency['measurements'] == 50
    for quantile in ('median', 'p99'):
        ours, echo = (latency[side][f'{quantile}_us'] for side in ('controller', 'echo'))
        assert found[f'latency_ratio_{quantile}'] == pytest.approx(ours / echo)
        assert found[f'pid_latency_ratio_{quantile}'] == pytest.approx(
            latency['pid'][f'{quantile}_us'] / echo)
        assert min(ours, echo) > 0.0
    kept_up = [one['sent_hz'] for one in steps if one['kept_up']]
    assert found['max_rate_hz'] == (kept_up[-1] if kept_up else None)
    assert found['rate']['ended_by']
    for one in steps:
        assert one['sent'] == round(0.05 * one['rate_hz'])
        assert not (one['kept_up'] and one['unanswered'])
    for side in ('', 'compiled_', 'pid_'):
        assert found[f'{side}speedup_over_real_time'] == pytest.approx(
            50.0 / found[f'{side}lockstep']['seconds'])
    assert found['startup_seconds'] > 0.0
    assert set(found['rss_megabytes']) == {'plant', 'controller', 'trainer', 'echo'}
    assert min(found['rss_megabytes'].values()) > 10.0


def test_nothing_is_lost_and_the_recorder_is_measured(figures):
    found = figures['recording']
    # the ladder ends before its second step where the publisher does not keep up the first
    assert found['ladder']
    for one, count in ((found['steady'], 1000), *zip(found['ladder'], (250, 1000), strict=False)):
        assert (one['sent'], one['recorded'], one['lost']) == (count, count, 0)
        assert one['in_order']
        assert 0.0 < one['cpu_share'] < 1.5
        assert one['peak_memory_megabytes'] > 20.0
    if sum(one['publisher_kept_up'] for one in found['ladder']) == 2:
        assert found['ladder_ended_by'] == 'the last step of the ladder'
    assert found['highest_hz_without_loss'] == found['ladder'][-1]['sent_hz']


def test_writers_stand_side_by_side(figures):
    memory = figures['recording']['from_memory']
    assert memory['messages'] == 3000
    for compression in ('none', 'zstd'):
        plain, ours = (memory[compression][name]['cpu_seconds_per_message']
                       for name in ('plain_mcap', 'our_writer'))
        assert memory[compression]['cpu_ratio_to_plain_mcap'] == pytest.approx(ours / plain)
        assert min(ours, plain) > 0.0
    plain = memory['none']['plain_mcap']['cpu_seconds_per_message']
    assert figures['recording']['recorder_cpu_ratio_to_plain_mcap']['1000'] == pytest.approx(
        figures['recording']['steady']['cpu_seconds_per_message'] / plain)
