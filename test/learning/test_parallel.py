# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The same bits whether starts run one after the other, in processes, threads or on Dask."""

import contextlib
from dataclasses import replace
import logging
import os
from pathlib import Path
import signal
import subprocess
import sys
import warnings

import joblib
import numpy as np
import pytest
import torch

import koopman_ros
from koopman_ros.learning import train, training
from support.small_plants import BENT, bent_samples, bits, SMALL

RECIPE = replace(SMALL, n_z=3)


def trained():
    return train(BENT, bent_samples(), RECIPE, starts=3, seed=5, loops=16)


@pytest.fixture(scope='module')
def expected():
    return bits(trained().model)


@contextlib.contextmanager
def dask():
    """Start a Dask cluster of two threads in this process."""
    with warnings.catch_warnings():
        # its own imports
        warnings.simplefilter('ignore')
        distributed = pytest.importorskip('distributed')
    # its ports are free ones of the loopback interface
    with (distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, host='127.0.0.1',
            protocol='tcp://', dashboard_address='127.0.0.1:0',
            silence_logs=logging.CRITICAL) as cluster,
          distributed.Client(cluster), joblib.parallel_config('dask')):
        yield


@pytest.mark.parametrize('backend', [
    lambda: joblib.parallel_config('loky', n_jobs=2),
    lambda: joblib.parallel_config('threading', n_jobs=2),
    lambda: joblib.parallel_config('loky', n_jobs=1),
    dask], ids=['loky', 'threading', 'one job', 'dask'])
def test_the_bits_do_not_depend_on_where_starts_run(backend, expected):
    threads = torch.get_num_threads()
    with backend():
        assert bits(trained().model) == expected
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(('backend', 'leaves'), [('loky', True), ('threading', False)])
def test_workers_leave_an_interrupt_to_the_process_that_waits(backend, leaves):
    """Between two starts they would print where they were."""
    class Probe:
        """A recipe whose start says how its process answers an interrupt."""

        def start(self, *_):
            return signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    # in the background of a shell all of them would ignore it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with joblib.parallel_config(backend, n_jobs=2):
            answers = joblib.Parallel()(joblib.delayed(training._start)(
                Probe(), None, 2, None, 0, 1, None) for _ in range(2))
    finally:
        signal.signal(signal.SIGINT, before)
    assert answers == [leaves, leaves]


def test_many_samples_go_to_processes():
    """Arrays beyond a megabyte come to them mapped to memory, read-only."""
    some = bent_samples(length=40_000)
    assert some.x.nbytes > 1 << 20
    recipe = replace(SMALL, max_iterations=2, tolerance=0.0)
    one = train(BENT, some, recipe, starts=1, loops=16)
    with joblib.parallel_config('loky', n_jobs=2):
        assert bits(train(BENT, some, recipe, starts=1, loops=16).model) == bits(one.model)
    assert np.isfinite(one.figures.fit.rw)


def test_the_watch_can_end_starts_in_processes():
    seen = []

    def watch(now):
        seen.append(now)
        return now.finished == 4

    with joblib.parallel_config('loky', n_jobs=2):
        kept = train(BENT, bent_samples(), RECIPE, starts=3, seed=5, loops=16,
                     watch=watch)
    # processes tell of whole starts only
    assert [(now.n_z, now.finished, now.iteration) for now in seen] == [
        (2, 1, 0), (2, 2, 0), (2, 3, 0), (3, 4, 0)]
    assert kept.status.startswith('interrupted')
    assert (kept.model.n_z, kept.starts) == (3, 4)


PROGRAM = """
import signal
import joblib
from koopman_ros.learning import Growth, train
from support.small_plants import BENT, bent_samples

def watch(now):
    print(now.n_z, now.finished, now.iteration, flush=True)
    return False

# started in the background of a shell, it would ignore it
signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == '__main__':
    with joblib.parallel_config('loky', n_jobs=2):
        # endless, or it could be over before a busy machine interrupts it
        recipe = Growth(200, max_iterations=60, tolerance=0.0)
        found = train(BENT, bent_samples(length=300), recipe, starts=2, watch=watch)
    print('model', found.model.n_z, found.status)
"""


def test_an_interrupt_from_the_keyboard():
    """Interrupt the whole process group, as a terminal does, once the first round is over."""
    here = Path(__file__).parents[1]
    path = os.pathsep.join([str(here), str(Path(koopman_ros.__file__).parents[1])])
    with subprocess.Popen(
            [sys.executable, '-c', PROGRAM], stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, start_new_session=True,
            env={**os.environ, 'PYTHONPATH': path, 'OMP_NUM_THREADS': '1'}) as process:
        try:
            for line in process.stdout:
                if line.startswith('3 '):
                    break
            os.killpg(process.pid, signal.SIGINT)
            output, errors = process.communicate(timeout=240)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert errors == ''
    assert process.returncode == 0
    last = output.splitlines()[-1]
    assert last.startswith('model ')
    assert last.endswith('interrupted: the best parameters so far are kept')
