# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The process that replays, as its parent sees it."""

import os
from pathlib import Path
import resource
import subprocess
import sys
import time

from koopman_ros.execution.job import ReplayJob
from support.nodes import TIMEOUT, wait_until_ended

START = """
import sys
from koopman_ros.execution.job import ReplayJob
job = ReplayJob(['--ros-args', '-p', 'bags:=[none.mcap]'])
print(job.process.pid, flush=True)
sys.stdin.read()
"""


def test_it_ends_with_the_process_that_started_it() -> None:
    with subprocess.Popen([sys.executable, '-c', START],
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        try:
            assert parent.stdout is not None
            child = int(parent.stdout.readline())
        finally:
            parent.kill()
    wait_until_ended(child)


def test_it_gives_way_and_says_what_is_wrong(tmp_path: Path) -> None:
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
    assert "bag 'none.mcap' does not exist" in job.said
