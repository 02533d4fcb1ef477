# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The same bits whether starts run one after the other, in processes, threads or on Dask."""

import contextlib
from dataclasses import replace
import os
from pathlib import Path
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch

import koopman_ros
from koopman_ros.jobs.backends import Here
from koopman_ros.learning import train
from support.places import KINDS, places
from support.small_plants import BENT, bent_samples, bits, SMALL

RECIPE = replace(SMALL, n_z=3)


def trained(backend, watch=None):
    return train(BENT, bent_samples(), RECIPE, starts=3, seed=5, loops=16, backend=backend,
                 watch=watch)


@pytest.fixture(scope='module')
def expected():
    return bits(trained(None).model)


@pytest.fixture(scope='module', name='places')
def every_place():
    with places() as opened:
        yield opened


@pytest.mark.parametrize('kind', KINDS)
def test_the_bits_do_not_depend_on_where_starts_run(kind, expected, places):
    threads = torch.get_num_threads()
    assert bits(trained(places[kind]).model) == expected
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize('kind', KINDS)
def test_the_watch_follows_and_can_end_starts_anywhere(kind, places):
    seen = []

    def watch(now):
        seen.append(now)
        return now.finished == 4

    kept = trained(places[kind], watch)
    # whole starts come in their order wherever they run, and steps of them before
    finished = [(now.n_z, now.finished) for now in seen]
    assert finished == sorted(finished)
    assert {(2, 1), (2, 2), (2, 3), (3, 4)} <= set(finished) <= {
        (2, 0), (2, 1), (2, 2), (2, 3), (3, 3), (3, 4)}
    # elsewhere a start may end before it tells of a second step
    assert kind or any(now.iteration and np.isfinite(now.residual) for now in seen)
    assert kept.status.startswith('interrupted')
    assert (kept.model.n_z, kept.starts) == (3, 4)


def test_many_samples_go_to_processes(places):
    some = bent_samples(length=40_000)
    assert some.x.nbytes > 1 << 20
    recipe = replace(SMALL, max_iterations=2, tolerance=0.0)
    one, other = (train(BENT, some, recipe, starts=1, loops=16, backend=backend)
                  for backend in (Here(), places['process']))
    assert bits(other.model) == bits(one.model)
    assert np.isfinite(one.figures.fit.rw)


def test_a_start_that_fails_is_named(places):
    """Not all of the samples span another coordinate."""
    class Failing(type(RECIPE)):
        def start(self, *_):
            raise ValueError('no new coordinate can be started')

    for backend in places.values():
        with pytest.raises(ValueError, match='no new coordinate') as caught:
            train(BENT, bent_samples(), Failing(2), starts=2, backend=backend)
        assert caught.value.__notes__ == ['in start 1 with n_z = 2']


PROGRAM = """
import signal
from koopman_ros.jobs.backends import backend_of
from koopman_ros.learning import Growth, train
from support.small_plants import BENT, bent_samples

def watch(now):
    print(now.n_z, now.finished, flush=True)
    return False

# started in the background of a shell, it would ignore it
signal.signal(signal.SIGINT, signal.default_int_handler)
if __name__ == '__main__':
    with backend_of('joblib:2') as backend:
        # endless, or it could be over before a busy machine interrupts it
        recipe = Growth(200, max_iterations=60, tolerance=0.0)
        found = train(BENT, bent_samples(length=300), recipe, starts=2, watch=watch,
                      loops=16, backend=backend)
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
