# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The process that replays, as its parent sees it."""

import os
from pathlib import Path
import resource
import time

from koopman_ros.execution.job import ReplayJob
from support.nodes import TIMEOUT


def test_the_experiment_ends_with_its_reason(tmp_path: Path) -> None:
    job = ReplayJob(['--ros-args', '-p', 'bags:=[none.mcap]', '-p', f'output:={tmp_path}/out'])
    try:
        assert os.getpriority(os.PRIO_PROCESS, job.process.pid) >= 10
        for limit in (resource.RLIMIT_DATA, resource.RLIMIT_CPU):
            assert resource.prlimit(job.process.pid, limit)[1] != resource.RLIM_INFINITY
        deadline = time.monotonic() + TIMEOUT
        while job.running:
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        job.close()
    assert "bag 'none.mcap' does not exist" in job.last_output
