# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One protocol wherever work runs: order, progress, cancel, failure and what is kept."""

import contextlib
import logging
import os
import re
import signal

import numpy as np
import pytest

from koopman_ros.execution import backend_of, SchedulerLost, Serial, WorkerLost
from koopman_ros.execution.pools import Cluster, Processes
from koopman_ros.parameters.trainer import trainer_table
from support.places import KINDS, places

ELSEWHERE = KINDS[1:]


@pytest.fixture(scope='module', name='places')
def every_place():
    with places() as opened:
        yield opened


@pytest.fixture(params=KINDS)
def place(places, request):
    return places[request.param]


def test_results_come_in_the_order_of_the_items(place):
    """The first one waits for the last, where they run side by side."""
    items = {f'item {n}': n for n in range(7)}
    found = list(place.run(lambda shared, n, _: (shared + n) ** 2, items, shared=100))
    assert found == [(f'item {n}', (100 + n) ** 2) for n in range(7)]
    assert list(place.run(lambda *_: 1, {})) == []


def test_the_bits_do_not_depend_on_the_place(place):
    def product(shared, seed, _):
        return (shared @ np.random.default_rng(seed).normal(size=(64, 64))).tobytes()

    matrix = np.random.default_rng(0).normal(size=(64, 64))
    items = {str(n): n for n in range(3)}
    assert list(place.run(product, items, shared=matrix)) == list(
        Serial().run(product, items, shared=matrix))


def test_what_tasks_tell_is_watched(place):
    def work(_, n, tell):
        tell(('at', n))
        return n

    told = []
    list(place.run(work, {'a': 1, 'b': 2}, watch=lambda name, value: told.append((name, value))))
    # the last words of a task may come after its result
    assert {pair for pair in told if pair != ('', None)} <= {('a', ('at', 1)), ('b', ('at', 2))}


def test_a_watch_ends_what_is_under_way_and_begins_nothing_else(place, tmp_path):
    """Tasks return what they have when they are asked to end."""
    def until_asked(folder, n, tell):
        (folder / f'{n} begun').touch()
        while not tell(n):
            pass
        return 'ended', n

    items = {f'task {n}': n for n in range(40)}
    found = list(place.run(until_asked, items, shared=tmp_path,
                           watch=lambda *_: any(tmp_path.iterdir())))
    assert 1 <= len(found) <= 2
    assert all(items[name] == n and ended == 'ended' for name, (ended, n) in found)
    # it is free again
    assert list(place.run(lambda *_: 5, {'next': None})) == [('next', 5)]


def test_an_early_end_leaves_the_place_usable(place):
    with contextlib.closing(place.run(lambda _, n, __: n, {str(n): n for n in range(5)})) as found:
        assert next(found) == ('0', 0)
    assert list(place.run(lambda *_: 5, {'next': None})) == [('next', 5)]


def test_an_exception_names_its_task(place):
    def work(_, n, __):
        if n == 1:
            raise FileNotFoundError('no such bag')
        return n

    with pytest.raises(FileNotFoundError, match='no such bag') as caught:
        list(place.run(work, {'first': 0, 'second': 1, 'third': 2}))
    assert caught.value.__notes__ == ['in second']
    assert list(place.run(work, {'again': 0})) == [('again', 0)]


def test_an_exception_of_a_watch_ends_the_work(places):
    class StopError(Exception):
        pass

    def watch(*_):
        raise StopError

    for kind in ELSEWHERE:
        with pytest.raises(StopError):
            list(places[kind].run(lambda _, __, tell: tell(0), {'a': 0}, watch=watch))


def test_what_is_loaded_stays(place, tmp_path):
    """Each item is read once, and only results come back, in the order of the items."""
    def load(n):
        with open(tmp_path / f'{n}', 'a') as file:
            file.write('read\n')
        return np.full(1000, float(n))

    with contextlib.closing(place.keep(load, {f'shard {n}': n for n in range(3)})) as kept:
        for factor in (1.0, 2.0, 3.0):
            assert kept.run(lambda values, by: float(by * values.sum()), factor) == [
                0.0, 1000.0 * factor, 2000.0 * factor]
        assert [(tmp_path / f'{n}').read_text() for n in range(3)] == ['read\n'] * 3
        with pytest.raises(ZeroDivisionError) as caught:
            kept.run(lambda values, _: 1 // int(values[0] - 1.0), None)
        assert caught.value.__notes__ == ['in shard 1']


def test_what_cannot_be_loaded_names_its_item(place):
    with pytest.raises(FileNotFoundError) as caught, contextlib.closing(
            place.keep(open, {'a shard': '/nowhere'})) as kept:
        kept.run(lambda *_: None, None)
    assert caught.value.__notes__ == ['in a shard']


def test_a_process_that_is_killed_is_replaced(places, tmp_path):
    def dies_once(folder, n, _):
        if n == 1 and not (folder / 'died').exists():
            (folder / 'died').touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return n

    found = list(places['joblib:2'].run(dies_once, {str(n): n for n in range(4)},
                                        shared=tmp_path))
    assert found == [(str(n), n) for n in range(4)]
    (tmp_path / 'died').unlink()
    with contextlib.closing(places['joblib:2'].keep(lambda n: n, {'a': 0, 'b': 1})) as kept:
        assert kept.run(lambda n, _: dies_once(tmp_path, n, None), None) == [0, 1]


def test_a_process_that_is_stopped_is_replaced(tmp_path):
    def freezes_once(folder, n, _):
        if not (folder / 'frozen').exists():
            (folder / 'frozen').touch()
            os.kill(os.getpid(), signal.SIGSTOP)
        return n

    with Processes(1, silence=0.2) as own:
        assert list(own.run(freezes_once, {'a': 1, 'b': 2}, shared=tmp_path)) == [
            ('a', 1), ('b', 2)]
        (tmp_path / 'frozen').unlink()
        with contextlib.closing(own.keep(lambda n: n, {'a': 1, 'b': 2})) as kept:
            assert kept.run(lambda n, _: freezes_once(tmp_path, n, None), None) == [1, 2]


def test_a_task_that_fails_leaves_the_others_alone(place):
    def work(_, n, __):
        return 6 // n

    found = dict(place.run(work, {'a': 1, 'zero': 0, 'b': 2}, apart=True))
    assert (found['a'], found['b']) == (6, 3)
    assert isinstance(found['zero'], ZeroDivisionError)
    assert found['zero'].__notes__ == ['in zero']


def test_a_task_that_kills_its_processes_leaves_the_others_alone(places):
    def work(_, n, __):
        return n or os.kill(os.getpid(), signal.SIGKILL)

    found = dict(places['process'].run(work, {'a': 1, 'deadly': 0, 'b': 2}, apart=True))
    assert (found['a'], found['b']) == (1, 2)
    assert isinstance(found['deadly'], WorkerLost)


def test_a_task_that_kills_its_processes_is_given_up(places):
    with pytest.raises(WorkerLost, match='deadly: 3 workers that ran it were killed'):
        list(places['process'].run(lambda *_: os.kill(os.getpid(), signal.SIGKILL),
                                   {'deadly': None}))


def test_a_process_has_one_thread_and_leaves_an_interrupt_alone(places):
    def probe(*_):
        return os.environ['OMP_NUM_THREADS'], signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    with pytest.MonkeyPatch.context() as patch:
        patch.delenv('OMP_NUM_THREADS', raising=False)
        with Processes(1) as own:
            assert list(own.run(probe, {'probe': None})) == [('probe', ('1', True))]


@pytest.mark.parametrize('text', [
    'joblib:0', 'joblib:-1', 'joblib:x', 'dask', 'tcp:', 'udp://a:1'])
def test_other_names_are_refused(text):
    with pytest.raises(ValueError, match=f'scheduler is {text!r}, must be empty for this process'):
        backend_of(text)


def test_a_scheduler_without_workers(places, monkeypatch):
    monkeypatch.setattr('koopman_ros.execution.pools._JOIN', 0.1)
    import distributed
    with distributed.LocalCluster(
            n_workers=0, processes=False, host='127.0.0.1', protocol='tcp://',
            dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL) as empty:
        text = f'the scheduler at {empty.scheduler_address} has had no worker for {{:g}} s: start'
        with pytest.raises(WorkerLost, match=re.escape(text.format(0.1))):
            Cluster(empty.scheduler_address)
        monkeypatch.setattr(Cluster, 'wait_for_workers', lambda *_: None)
        with Cluster(empty.scheduler_address, silence=0.2) as deserted, pytest.raises(
                WorkerLost, match=re.escape(text.format(0.2))):
            list(deserted.run(lambda *_: None, {'a task': 0}))


def test_the_trainer_refuses_other_names():
    table = trainer_table(None, {
        'system': 'own', 'states_measured': ['x [m]'], 'inputs_commanded': ['u [V]']})
    for text in KINDS[:3]:
        assert 'scheduler' not in table.check(table.snapshot({'scheduler': text}))
    assert table.check(table.snapshot({'scheduler': 'dask'})).startswith("scheduler is 'dask', ")
    assert table.snapshot({'device': 'cuda'}).training()['device'] == 'cuda'


def test_an_address_without_a_scheduler(monkeypatch):
    monkeypatch.setattr('koopman_ros.execution.pools._CONNECT', 0.3)
    with pytest.raises(SchedulerLost, match=r'no scheduler answers at tcp://127\.0\.0\.1:9 '):
        backend_of('tcp://127.0.0.1:9')
