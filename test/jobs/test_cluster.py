# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Training on real processes of Dask, of which one is killed, one is frozen, and all are lost."""

from dataclasses import replace
import signal

import numpy as np
import pytest

from koopman_ros.jobs.backends import SchedulerLost
from koopman_ros.jobs.cluster import Cluster
from koopman_ros.learning import read_samples, Shard, train, write_samples
from koopman_ros.testing.cluster import DaskProcesses
from support.small_plants import BENT, bent_samples, bits, SMALL

RECIPE = replace(SMALL, max_iterations=6)
SILENCE = 2.0  # s


@pytest.fixture
def shards(tmp_path):
    samples = bent_samples(length=100, seed=3)
    found = []
    for number in range(3):
        path = tmp_path / f'{number}.npz'
        write_samples(path, samples.where(np.arange(len(samples)) % 3 == number))
        found.append(Shard(f'shard {number}', read_samples, (path,)))
    return found


def trained(backend, shards, watch=None):
    return bits(train(BENT, bent_samples(), RECIPE, starts=1, loops=0, backend=backend,
                      shards=shards, watch=watch).model)


@pytest.mark.timeout(240)
def test_workers_and_scheduler_are_lost_in_mid_training(tmp_path, shards):
    """The model is the same to the bit as long as a worker is left, else the error is clear."""
    def in_mid_training(act):
        def watch(now):
            if now.iteration == 2:
                act()
            return False

        return watch

    expected = trained(None, shards)
    with DaskProcesses(tmp_path) as dask:
        killed, frozen = dask.start_worker(), dask.start_worker()
        with Cluster(dask.address, SILENCE) as cluster:
            cluster.wait_for_workers(2)
            assert trained(cluster, shards, in_mid_training(killed.process.kill)) == expected
            dask.start_worker()
            cluster.wait_for_workers(2)
            assert trained(cluster, shards, in_mid_training(
                lambda: frozen.process.send_signal(signal.SIGSTOP))) == expected
            # one that wakes up is no longer of use, nor in the way
            frozen.process.send_signal(signal.SIGCONT)
            assert trained(cluster, shards) == expected
            with pytest.raises(SchedulerLost, match='is lost, and the work with it: start it'):
                trained(cluster, shards, in_mid_training(dask.scheduler.process.kill))
