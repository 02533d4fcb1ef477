# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a panel that was ended by force leaves behind is removed by the next one."""

import os
from pathlib import Path
import subprocess
import sys
import tempfile

import pytest

from koopman_ros.ros.learning import remove_leftovers


def test_folders_of_panels_that_are_gone_are_removed_and_no_others(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    gone = subprocess.Popen([sys.executable, '-c', ''])
    assert gone.wait() == 0
    left = tmp_path / f'koopman_ros_panel_{gone.pid}_a'
    own = tmp_path / f'koopman_ros_panel_{os.getpid()}_b'
    elsewhere = tmp_path / 'elsewhere'
    for folder in (left, own, elsewhere, tmp_path / 'koopman_ros_panel_x_c'):
        folder.mkdir()
        (folder / 'report.md').write_text('')
    # nothing is followed out of there
    (tmp_path / f'koopman_ros_panel_{gone.pid}_d').symlink_to(elsewhere)
    remove_leftovers()
    assert not left.exists()
    for folder in (own, elsewhere, tmp_path / 'koopman_ros_panel_x_c'):
        assert (folder / 'report.md').exists()
