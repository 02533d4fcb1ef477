# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The harness: its processes end whatever happens, and it says what went wrong."""

import os
from pathlib import Path
import re
import signal
import sys

import pytest
from sensor_msgs.msg import Temperature

from koopman_ros.records import summary
from koopman_ros.testing import (
    Harness,
    HarnessError,
    isolated_domain,
    NodeProcess,
    process,
    reserved_output,
)
from support.nodes import TIMEOUT, wait_until_ended

SLEEPER = (sys.executable, '-c', 'import time; time.sleep(600)')


@pytest.mark.parametrize(('program', 'lasting', 'words'), [
    ('echo a reason; exit 3', False, 'failing ended early, with code 3: a reason'),
    ('exit 0', True, 'failing ended early'),
    ('exit 0', False, 'not within 1 s: the impossible; see ')])
def test_an_unrequested_end_of_a_process_is_reported(
        tmp_path: Path, program: str, lasting: bool, words: str) -> None:
    """One without an error counts where processes are to last."""
    ros = Harness(tmp_path, lasting=lasting, timeout=1.0)
    ros.start('failing', command=('sh', '-c', program)).process.wait()
    with pytest.raises(HarnessError, match=words), ros:
        ros.wait_until(bool, 'the impossible')


def test_code_at_the_end_counts_unless_the_process_was_stopped_before(tmp_path: Path) -> None:
    ros = Harness(tmp_path)
    ros.start('stopped', command=SLEEPER).stop(signal.SIGKILL)
    ros.start('left', command=('sleep', '600'))
    with pytest.raises(HarnessError, match=r'^left_1 ended with code -2; see ') as raised:
        ros.__exit__(None, None, None)
    assert raised.value.__notes__ == ['stopped_0.log: \nleft_1.log: ']


def test_error_of_the_test_is_raised_and_its_processes_end(tmp_path: Path) -> None:
    ros = Harness(tmp_path)
    sleeper = ros.start('sleeper', command=SLEEPER)
    with pytest.raises(ZeroDivisionError), ros:
        raise ZeroDivisionError
    assert not sleeper.running


# How a process meets its signals, the code with which it ends, and its last words.
STUBBORN = {
    'blocks the signal': (
        'signal.pthread_sigmask(signal.SIG_BLOCK, {2})\n', -signal.SIGABRT, 'in <module>'),
    'blocks the abort, too': (
        'signal.pthread_sigmask(signal.SIG_BLOCK, {2, 6})\n', -signal.SIGKILL, ''),
    'is stopped': ('signal.signal(signal.SIGINT, lambda *_: sys.exit(7))\n'
                   'print("ready", flush=True)\n'
                   'signal.raise_signal(signal.SIGSTOP)\n', 7, ''),
}


@pytest.mark.parametrize('name', STUBBORN)
def test_a_process_that_does_not_end_is_aborted_with_its_stack(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    act, code, words = STUBBORN[name]
    if code < 0:
        monkeypatch.setattr(process, 'STOP_TIMEOUT', 0.2)
        monkeypatch.setattr(process, '_ABORT_TIMEOUT', 0.2 if code == -signal.SIGKILL else TIMEOUT)
    stubborn = NodeProcess('stubborn', {}, tmp_path / 'log', {}, command=(
        sys.executable, '-c', 'import signal, sys, time\n'
        f'{act}print("ready", flush=True)\ntime.sleep(600)\n'))
    while 'ready' not in stubborn.output():
        assert stubborn.running
    assert stubborn.stop() == code
    assert words in stubborn.output()


def test_a_publisher_waits_for_the_node_and_not_for_another_subscriber(tmp_path: Path) -> None:
    with Harness(tmp_path, timeout=1.0) as ros:
        ros.listen(Temperature, 'elsewhere')
        with pytest.raises(HarnessError, match='no subscription of /trainer to /elsewhere'):
            ros.speak(Temperature, 'elsewhere', to='trainer')


def test_example_of_the_page_passes(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / 'docs' / 'how-to' / 'test_nodes.md'
    _, example, _ = re.split('```(?:python)?\n', page.read_text())
    exec(example, names := {})
    (test,) = (found for name, found in names.items() if name.startswith('test_'))
    test(tmp_path)


# What is left when this process is killed.


PARENT = """
import threading, time
from pathlib import Path
from koopman_ros.testing import NodeProcess, process
process.STOP_TIMEOUT = {patience}
def start():
    child = NodeProcess({name!r}, {parameters!r}, Path({log!r}), {{}}, command={command!r})
    print(child.process.pid, flush=True)
# a signal at the death of the parent would come with the end of this thread
thread = threading.Thread(target=start)
thread.start()
thread.join()
time.sleep(600)
"""
IGNORING = ('import signal, time\n'
            'signal.signal(signal.SIGINT, signal.SIG_IGN)\n'
            'print("ready", flush=True)\n'
            'time.sleep(600)\n')
HALTED = 'import signal\nprint("ready", flush=True)\nsignal.raise_signal(signal.SIGSTOP)\n'


def orphan(ros: Harness, log: Path, patience: float = TIMEOUT, **child: object) -> int:
    """Start a process that starts another one; return the number of that one."""
    parent = ros.start('parent', command=(sys.executable, '-c', PARENT.format(
        log=str(log), patience=patience, **{'parameters': {}, 'command': None, **child})))
    ros.wait_until(lambda: parent.output().endswith('\n'))
    return int(parent.output())


def test_node_of_a_process_that_is_killed_completes_its_work(ros: Harness, tmp_path: Path) -> None:
    bag = tmp_path / 'bag.mcap'
    child = orphan(ros, tmp_path / 'child.log', name='trainer', parameters={'output': str(bag)})
    ros.meet('trainer')
    ros.processes[0].stop(signal.SIGKILL)
    wait_until_ended(child)
    assert summary(bag).complete


@pytest.mark.parametrize(('program', 'patience'), [(IGNORING, 0.1), (HALTED, TIMEOUT)],
                         ids=['ignores the interrupt', 'is halted'])
def test_no_process_outlives_one_that_is_killed(
        ros: Harness, tmp_path: Path, program: str, patience: float) -> None:
    log = tmp_path / 'child.log'
    child = orphan(ros, log, patience, name='child', command=(sys.executable, '-c', program))
    ros.wait_until(lambda: 'ready' in log.read_text())
    ros.processes[0].stop(signal.SIGKILL)
    wait_until_ended(child)


def test_reservation_ends_with_its_context(monkeypatch: pytest.MonkeyPatch) -> None:
    # one that no other test reserves meanwhile
    monkeypatch.setattr(process, '_DOMAINS', [1000 + os.getpid()])
    for _ in range(2):
        with isolated_domain() as environment:
            assert environment['ROS_DOMAIN_ID'] == str(1000 + os.getpid())
            with pytest.raises(RuntimeError, match='taken'), isolated_domain():
                pass


def test_two_runs_write_to_two_folders(tmp_path: Path) -> None:
    (tmp_path / 'link').symlink_to(tmp_path)
    with (reserved_output(tmp_path / 'demo') as first,
          reserved_output(tmp_path / 'link' / 'demo') as second):
        assert (first, second) == (tmp_path / 'demo', tmp_path / 'link' / 'demo-2')
    with reserved_output(tmp_path / 'demo') as again:
        assert again == first


@pytest.mark.parametrize(('given', 'reach'), [
    ('', 'SYSTEM_DEFAULT'), ('rmw_fastrtps_dynamic_cpp', 'SYSTEM_DEFAULT'),
    # whose default is the whole network, as it knows nothing of the profile
    ('rmw_cyclonedds_cpp', 'LOCALHOST')])
def test_environment_of_the_reservation_holds_here_with_the_middleware_that_is_named(
        monkeypatch: pytest.MonkeyPatch, given: str, reach: str) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    monkeypatch.setenv('RMW_IMPLEMENTATION', given)
    with isolated_domain() as environment:
        assert environment.items() <= os.environ.items()
        assert environment['RMW_IMPLEMENTATION'] == (given or 'rmw_fastrtps_cpp')
        assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == reach
    assert (os.environ['ROS_DOMAIN_ID'], os.environ['RMW_IMPLEMENTATION']) == ('7', given)
