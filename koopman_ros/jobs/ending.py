# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The end of a process that was asked to end."""

import subprocess
from typing import Any

_PATIENCE = 5.0  # s from the request to end until the process is killed


def see_it_end(process: subprocess.Popen[Any]) -> None:
    """Wait until a process has ended that was asked to, and end it by force if it takes long."""
    try:
        process.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
