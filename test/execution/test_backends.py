# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One interface on every backend: order, progress, cancel, failure, loss of workers."""

import contextlib
import logging
import os
import signal
import time
import warnings

import numpy as np
import pytest

from koopman_ros.execution import backend_of, SchedulerLost, Serial, WorkerLost
from koopman_ros.execution.pools import Cluster, Processes
from koopman_ros.parameters.trainer_table import trainer_table
from support.nodes import TIMEOUT

KINDS = ('', 'process', 'joblib:2', 'dask')


@pytest.fixture(scope='module')
def places():
    """Open every back end once; the Dask cluster has two threads in this process."""
    with contextlib.ExitStack() as stack:
        with warnings.catch_warnings():
            # its own imports
            warnings.simplefilter('ignore')
            import distributed
        # its ports are free ones of the loopback interface
        cluster = stack.enter_context(distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, host='127.0.0.1',
            protocol='tcp://', dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL))
        yield {kind: stack.enter_context(backend_of(
            cluster.scheduler_address if kind == 'dask' else kind)) for kind in KINDS}


@pytest.fixture(params=KINDS)
def place(places, request):
    return places[request.param]


def numbers(count):
    return {f'task {n}': n for n in range(count)}


def test_results_come_in_order_with_the_same_bits(place):
    def product(shared, seed, _):
        return (shared @ np.random.default_rng(seed).normal(size=(64, 64))).tobytes()

    matrix = np.random.default_rng(0).normal(size=(64, 64))
    assert list(place.run(product, numbers(7), shared=matrix)) == list(
        Serial().run(product, numbers(7), shared=matrix))
    assert list(place.run(product, {})) == []


def test_progress_reaches_the_watch(place, tmp_path):
    def work(folder, n, tell):
        while not (folder / f'{n}').exists():
            tell(('at', n))
        return n

    told = set()

    def watch(name, value):
        if value is not None:
            told.add((name, value))
            (tmp_path / name.removeprefix('task ')).touch()
        return False

    list(place.run(work, numbers(2), shared=tmp_path, watch=watch))
    assert told == {(f'task {n}', ('at', n)) for n in range(2)}


def test_a_watch_ends_running_tasks_and_begins_no_other(place, tmp_path):
    def until_asked(folder, n, tell):
        (folder / f'{n} begun').touch()
        while not tell(n):
            pass
        return 'ended', n

    found = list(place.run(until_asked, numbers(40), shared=tmp_path,
                           watch=lambda *_: any(tmp_path.iterdir())))
    assert 1 <= len(found) <= 2
    assert all(name == f'task {n}' and ended == 'ended' for name, (ended, n) in found)
    assert list(place.run(lambda *_: 5, {'next': None})) == [('next', 5)]


def test_failures_name_their_task_and_leave_the_place_usable(place):
    def work(_, n, __):
        return 6 // n

    with pytest.raises(ZeroDivisionError) as caught:
        list(place.run(work, {'a': 1, 'zero': 0}))
    assert caught.value.__notes__ == ['in zero']
    with contextlib.closing(place.run(work, {'a': 1, 'b': 2, 'c': 3})) as closed_early:
        assert next(closed_early) == ('a', 6)

    def watch(*_):
        raise KeyError

    with pytest.raises(KeyError):
        list(place.run(lambda _, __, tell: tell(0), {'a': 0}, watch=watch))
    assert list(place.run(work, {'next': 1})) == [('next', 6)]


def test_a_task_whose_process_dies_is_repeated_and_given_up_at_last(places, tmp_path):
    def dies(folder, n, _):
        if n == 1 and not (folder and (folder / 'died').exists()):
            if folder:
                (folder / 'died').touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return n

    place = places['joblib:2']
    assert list(place.run(dies, numbers(4), shared=tmp_path)) == [
        (f'task {n}', n) for n in range(4)]
    with pytest.raises(WorkerLost, match='task 1: 3 workers that ran it died'):
        list(place.run(dies, numbers(2)))


def test_a_task_that_does_not_end_is_abandoned(places, monkeypatch):
    monkeypatch.setattr('koopman_ros.execution.pools._PATIENCE', 0.2)

    def deaf(_, __, tell):
        tell(0)
        while True:
            pass

    assert list(places['process'].run(deaf, {'deaf': 0},
                                      watch=lambda _, value: value == 0)) == []
    assert list(places['process'].run(lambda *_: 5, {'next': None})) == [('next', 5)]


def test_a_process_has_one_thread_and_ignores_an_interrupt(monkeypatch):
    def probe(*_):
        return os.environ['OMP_NUM_THREADS'], signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    monkeypatch.delenv('OMP_NUM_THREADS', raising=False)
    with Processes(1) as own:
        assert list(own.run(probe, {'probe': None})) == [('probe', ('1', True))]


def test_a_scheduler_that_does_not_answer_or_has_no_worker(monkeypatch):
    with monkeypatch.context() as impatient:
        impatient.setattr('koopman_ros.execution.pools._CONNECT', 0.3)
        with pytest.raises(SchedulerLost, match=r'no scheduler answers at tcp://127\.0\.0\.1:9 '):
            backend_of('tcp://127.0.0.1:9')
    import distributed

    def cluster(workers):
        return distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=False, host='127.0.0.1',
            protocol='tcp://', dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL)

    def place_at(address):
        # a busy machine may take longer to connect
        while True:
            with contextlib.suppress(SchedulerLost):
                return Cluster(address)

    # also the time for which a lost scheduler is sought
    monkeypatch.setattr('koopman_ros.execution.pools._CONNECT', 2.0)
    with cluster(0) as empty, monkeypatch.context() as impatient:
        impatient.setattr('koopman_ros.execution.pools._JOIN', 0.1)
        with pytest.raises(WorkerLost, match='has no worker: start one'):
            place_at(empty.scheduler_address)
    monkeypatch.setattr('koopman_ros.execution.pools._JOIN', TIMEOUT)

    def until_lost(_, __, tell):
        while not tell(0):
            time.sleep(0.01)

    with cluster(1) as lost, place_at(lost.scheduler_address) as place:
        work = place.run(until_lost, {'a': 0}, watch=lambda name, _: bool(name) and lost.close())
        with pytest.raises(SchedulerLost, match='lost the connection'):
            list(work)


@pytest.mark.parametrize('text', [
    'joblib:0', 'joblib:-1', 'joblib:x', 'dask', 'tcp:', 'udp://a:1'])
def test_other_names_are_rejected(text):
    with pytest.raises(ValueError, match=f'executor is {text!r}, must be empty'):
        backend_of(text)
    table = trainer_table(None, {
        'system': 'own', 'states_measured': ['x [m]'], 'inputs_commanded': ['u [V]']})
    assert table.check(table.snapshot({'executor': text})).startswith('executor is ')
    assert 'executor' not in table.check(table.snapshot({'executor': 'joblib:2'}))
