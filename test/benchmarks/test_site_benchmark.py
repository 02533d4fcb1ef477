# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of many loops: its figures, from real processes, and what gives way."""

import json

import pytest

from benchmarks import site
from benchmarks.__main__ import main


def test_loops_of_a_process_and_processes_are_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(site.PLANS, 'quick', site.Plan(
        {'processes': (1,), 'hosted_with_plants': (2,), 'domains': (2,)}, 1, 1.0, 1, 60.0))
    monkeypatch.setattr(site, '_SETTLE', 0.5)
    assert main(['site', '--quick', '--output', str(tmp_path)]) == 0
    assert '| hosted_with_plants |' in capsys.readouterr().out
    assert (tmp_path / 'site.png').stat().st_size > 10_000
    found = json.loads((tmp_path / 'summary.json').read_text())['site']
    assert set(found['gives_way']) == {'processes', 'hosted_with_plants', 'domains'}
    for way, count in (('processes', '1'), ('hosted_with_plants', '2'), ('domains', '2')):
        one = found[way][count]
        assert one['answering'] == int(count)
        assert one['answered_share'] > 0.0
        assert 0.0 < one['cores'] < 2.0
        assert 20.0 < one['pss_megabytes'] <= one['rss_megabytes']
        assert 0.0 < one['p50_ms'] <= one['p99_ms']
        assert one['start_cpu_seconds'] > 0.0
        assert 0.0 < one['discovery_seconds'] < 60.0


def test_every_way_that_is_measured_has_a_meaning():
    for plan in site.PLANS.values():
        assert set(plan.loops) <= set(site.WAYS) <= set(site.MEANING)


def figures(answering=100, pss_megabytes=200.0, cores=0.4, p99_ms=20.0):
    return {'answering': answering, 'pss_megabytes': pss_megabytes, 'cores': cores,
            'p99_ms': p99_ms}


@pytest.mark.parametrize(('found', 'words'), [
    ({100: figures()}, 'nothing up to 100 loops'),
    ({100: figures(), 200: figures(200, cores=0.9, p99_ms=80.0)},
     'with 200 loops: cores 0.9, more than 0.5, p99_ms 80, more than 50'),
    ({100: figures(), 200: figures(120)}, 'the start, with 200 loops: 120 answer in time'),
])
def test_what_gives_way_first_is_named(found, words):
    assert site._gives_way(found) == words
