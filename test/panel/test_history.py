# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trends, events and actions that outlast the panel."""

import math
from pathlib import Path

import numpy as np
import pytest

from koopman_ros.panel.history import HistoryFile
from koopman_ros.panel.requests import AuditEntry
from koopman_ros.panel.view_model import LoopViewModel
from koopman_ros.parameters.signal_topics import Signals

NOW = 1_790_000_000.0
ACTION = AuditEntry(NOW, 'anna', 'setpoint level', 1.0, 2.0, 'm', True, 'accepted')


def view() -> LoopViewModel:
    signals = Signals({'level': 'm'}, {'pump': 'V'}, ('level',))
    return LoopViewModel(signals, signals.units, 3600.0, NOW)


def test_a_history_is_there_again_with_a_gap_where_the_panel_was_down(tmp_path: Path) -> None:
    before, path = view(), tmp_path / 'history.npz'
    file = HistoryFile(before, path, NOW)
    for second in range(20_000):
        before.trends.add('level', NOW + second, math.sin(second / 500.0))
    before.trends.mark(NOW + 5.0, 'set-point', 'level 1 → 2 m by anna')
    before.take_action(ACTION)
    file.save(NOW + 30.0)
    assert not view().audit
    # once a minute
    file.save(NOW + 61.0)
    again = view()
    HistoryFile(again, path, NOW + 20_100.0)
    again.trends.add('level', NOW + 20_100.0, 0.5)
    times, values = again.trends.window(['level'], NOW, NOW + 30_000.0)['level']
    assert np.nanmax(values) == pytest.approx(1.0, abs=1e-3)
    assert math.isnan(values[-2])
    assert times[-1] == NOW + 20_100.0
    assert [mark.text for mark in again.trends.marks(NOW, NOW + 10.0)] == ['level 1 → 2 m by anna']
    assert again.audit == (ACTION,)
    # the file is bounded, however long the history
    assert path.stat().st_size < 200_000


@pytest.mark.parametrize('content', [b'note', b'', b'PK\x03\x04'])
def test_a_file_of_something_else_is_not_replaced(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'history.npz'
    path.write_bytes(content)
    with pytest.raises((ValueError, OSError)):
        HistoryFile(view(), path, NOW)
    assert path.read_bytes() == content
