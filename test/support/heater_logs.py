# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The logs of a device with a dead time and an unmeasured state, as a tutorial writes them."""

from pathlib import Path
import runpy
import sys

import pytest

SCRIPT = Path(__file__).parents[2] / 'examples' / 'tutorials' / 'heater_board.py'
DAYS, COLD_DAY = ('heater_day_1.csv', 'heater_day_2.csv'), 'heater_cold_day.csv'


def write_heater_logs(folder: Path) -> None:
    """Write the logs to a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, 'argv', [SCRIPT.name, str(folder)])
        runpy.run_path(str(SCRIPT), run_name='__main__')
