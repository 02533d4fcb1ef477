# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of recording: the figures it leaves, from real processes."""

import pytest

from validation.benchmarks.recording import part, table

PLAN = part.Plan(seconds=1.0, rates=(500.0, 2000.0), ladder_seconds=0.5, messages=3000, runs=1)


def test_nothing_is_lost_and_the_recorder_is_measured(run):
    figures, _ = run
    # the ladder ends before its second step where the publisher does not keep up the first
    assert figures['ladder']
    for step, count in ((figures['steady'], 1000), *zip(figures['ladder'], (250, 1000),
                                                        strict=False)):
        assert (step['sent'], step['recorded'], step['lost']) == (count, count, 0)
        assert step['in_order']
        assert 0.0 < step['cpu_share'] < 1.5
        assert step['peak_memory_megabytes'] > 20.0
    assert figures['steady']['rate_hz'] == 1000.0


def test_highest_rate_is_the_last_that_was_kept_up(run):
    figures, _ = run
    kept_up = [step for step in figures['ladder'] if step['publisher_kept_up']]
    if len(kept_up) == 2:
        assert figures['ladder_ended_by'] == 'the last step of the ladder'
    assert figures['highest_hz_without_loss'] == figures['ladder'][-1]['sent_hz']


def test_writers_stand_side_by_side(run):
    figures, _ = run
    memory = figures['from_memory']
    assert memory['messages'] == 3000
    for compression in ('none', 'zstd'):
        plain, ours = (memory[compression][name]['cpu_seconds_per_message']
                       for name in ('plain_mcap', 'our_writer'))
        assert memory[compression]['cpu_ratio_to_plain_mcap'] == pytest.approx(ours / plain)
        assert min(ours, plain) > 0.0
    plain = memory['none']['plain_mcap']['cpu_seconds_per_message']
    assert figures['recorder_cpu_ratio_to_plain_mcap']['1000'] == pytest.approx(
        figures['steady']['cpu_seconds_per_message'] / plain)


def test_figures_are_saved_on_the_way(run):
    _, saved = run
    assert [('steady' in keys, 'ladder' in keys) for keys in saved] == [
        (True, False), (True, True)]


def test_table_holds_the_figures(run):
    figures, _ = run
    text = '\n'.join([*table.of_steady(figures['steady']), *table.of_ladder(figures),
                      *table.of_memory(figures)])
    assert '1000 messages sent, 1000 recorded, 0 lost' in text
    assert "mcap's writer from memory, zstd" in text
    assert f'recorder at {figures["ladder"][-1]["rate_hz"]:.0f} Hz' in text
