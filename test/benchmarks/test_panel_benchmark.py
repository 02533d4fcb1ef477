# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The benchmark of the operator's panel: its figures, from real processes and a real browser."""

import json
import warnings

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from benchmarks import panel
from benchmarks.__main__ import main


def run(folder, monkeypatch):
    """Return the figures that a short run leaves."""
    with warnings.catch_warnings():
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
        warnings.simplefilter('error')
        monkeypatch.setitem(panel.PLANS, 'quick', panel.Plan(0.7, 2, 1))
        monkeypatch.setattr(panel, '_SETTLE', 0.3)
        assert main(['panel', '--quick', '--output', str(folder)]) == 0
    return json.loads((folder / 'summary.json').read_text())['panel']


def test_the_panel_and_the_loop_beside_it_are_measured(tmp_path, monkeypatch, capsys):
    found = run(tmp_path, monkeypatch)
    assert '| 2 |' in capsys.readouterr().out
    assert set(found) >= {'machine', 'meaning'}
    first = found['first_load']
    assert first['requests'] > 5
    assert first['kilobytes'] > 100.0
    assert 0.0 < first['seconds'] < 60.0
    assert len(first['runs']) == 1
    for name, pages in (('one_page', 1), ('all_pages', 2)):
        one = found[name]
        assert one['opened'] == pages
        # as its diagnostics of the last second say
        assert one['pages'] == pages
        assert 0.0 < one['cpu_share'] < 4.0
        assert 20.0 < one['pss_megabytes'] <= one['rss_megabytes']
        assert 0.0 <= one['machine_share'] <= 1.0
        delay = one['delay']
        assert delay['count'] >= delay['of_shown']['count'] >= 1
        assert 0.0 < delay['median_ms'] <= delay['p99_ms']
    for name in ('without_panel', 'one_page', 'all_pages'):
        answer = found[name]['answer']
        assert answer['count'] >= 1
        assert 0.0 < answer['median_ms'] <= answer['p99_ms'] < 1000.0


def test_numbers_are_paired_with_their_messages():
    # 0.1 s apart; the page shows the third, the seventh and, much later, the thirty-first
    told = [100_000_000_000 + 100_000_000 * k for k in range(260)]
    seen = [[100_250.0, 0.0, '32.2'], [100_700.0, 0.0, '32.6'], [103_100.0, 0.0, '35.0']]
    found = panel._delays(told, 0, 10, seen)
    assert (found['count'], found['not_shown'], found['of_shown']['count']) == (10, 0, 2)
    assert found['of_shown']['median_ms'] == pytest.approx(75.0)
    # of 50, 100, 150, 200, 250, 300, 400, 2200, 2300, 2400
    assert found['median_ms'] == pytest.approx(275.0)
    # a range that begins later, and whose end is not shown
    found = panel._delays(told, 7, 50, seen)
    assert (found['count'], found['not_shown']) == (24, 19)
    # when the numbers have begun anew
    seen = [[120_600.0, 0.0, '32.5']]
    assert panel._delays(told, 205, 210, seen)['of_shown']['median_ms'] == pytest.approx(100.0)


@pytest.mark.parametrize(('lacking', 'said'), [
    ('nicegui', 'nicegui is missing: pip install nicegui'),
    ('playwright', 'playwright is missing: pip install playwright'),
    ('chromium', 'Chromium is missing: sudo apt-get install chromium')])
def test_what_is_missing_is_said(tmp_path, monkeypatch, capsys, lacking, said):
    monkeypatch.setattr(panel, 'find_spec', lambda name: None if name == lacking else name)
    monkeypatch.setattr(panel, '_chromium', lambda: None if lacking == 'chromium' else 'chromium')
    assert run(tmp_path, monkeypatch)['not_measured'] == said
    assert f'the panel is not measured: {said}\n' in capsys.readouterr().out
