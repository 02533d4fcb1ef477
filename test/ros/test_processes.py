# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Life of the processes: clean ends, bad starts in one line, imports, and how they are kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import ipaddress
import os
from pathlib import Path
import re
import signal
import subprocess
import sys

import pytest
from rclpy.utilities import get_rmw_implementation_identifier
from rosgraph_msgs.msg import Clock

from koopman_ros.bags import summary
from koopman_ros.resources import model_path
from koopman_ros.ros import command_line, topics
from koopman_ros.ros.codec import stamp_message
from koopman_ros.ros.exposure import open_to_the_network
from koopman_ros.ros.parameter_files import TABLES
from koopman_ros.testing import Harness, isolated_domain, NodeProcess
from koopman_ros.units import NANOSECONDS
from support.messages import TIMEOUT

# Ends.


@pytest.mark.parametrize(('name', 'number', 'unneeded'), [
    ('plant', signal.SIGINT, ('torch',)), ('controller', signal.SIGTERM, ('torch',)),
    ('trainer', signal.SIGINT, ('torch', 'scipy'))])
def test_signal_ends_a_node_cleanly_that_loads_only_what_it_needs(
        ros: Harness, tmp_path: Path, name: str, number: int, unneeded: tuple[str, ...]) -> None:
    program = (
        'import sys\n'
        'class Missing:\n'
        '    def find_spec(self, name, path=None, target=None):\n'
        f'        if name.split(".")[0] in {unneeded}:\n'
        '            raise AssertionError(f"{name} is imported")\n'
        'sys.meta_path.insert(0, Missing())\n'
        f'from koopman_ros.nodes.{name} import main\n'
        'sys.exit(main())\n')
    # the plant is in the middle of a callback whenever the signal comes
    parameters = {'plant': {'speed': 0.0}, 'controller': {},
                  'trainer': {'output': tmp_path / 'bag'}}[name]
    process = ros.start(name, parameters, command=(sys.executable, '-c', program))
    ros.meet(name)
    assert process.stop(number) == 0
    assert 'Traceback' not in process.output()
    said = {'plant': r'one_state reactor started: ', 'controller': 'reactor_nz4',
            'trainer': rf'recorded \d+ messages to {re.escape(str(tmp_path))}/bag\n'}[name]
    assert re.search(said, process.output())


@pytest.mark.parametrize(('name', 'number', 'code'), [
    ('plant', signal.SIGTERM, 0), ('replay', signal.SIGINT, 130)])
def test_signal_while_a_program_loads_ends_it_without_a_word(
        ros: Harness, name: str, number: int, code: int) -> None:
    program = (
        'import os, signal, sys\n'
        'class Interrupted:\n'
        '    def find_spec(self, name, path=None, target=None):\n'
        '        if name == "scipy":\n'
        f'            os.kill(os.getpid(), {int(number)})\n'
        'sys.meta_path.insert(0, Interrupted())\n'
        f'from koopman_ros.startup import {name} as program\n'
        'sys.exit(program())\n')
    process = ros.start(name, command=(sys.executable, '-c', program))
    assert ros.wait_for_end(process) == code
    assert process.output() == ''


def test_signal_before_the_interpreter_is_up_ends_a_node_cleanly(ros: Harness) -> None:
    process = ros.start('plant')
    assert process.stop(signal.SIGTERM) == 0
    assert process.output() == ''


def test_signal_during_the_start_ends_a_node_cleanly(ros: Harness) -> None:
    program = (
        'import os, sys\n'
        'from koopman_ros.nodes.plant import PlantNode\n'
        'from koopman_ros.ros.process import run\n'
        'def create():\n'
        f'    os.kill(os.getpid(), {int(signal.SIGTERM)})\n'
        '    return PlantNode()\n'
        'sys.exit(run("plant", create))\n')
    process = ros.start('plant', command=(sys.executable, '-c', program))
    assert ros.wait_for_end(process) == 0
    assert 'Traceback' not in process.output()


def test_signal_at_the_end_of_the_interpreter_changes_nothing(ros: Harness) -> None:
    # what a module holds goes when the interpreter has given up its handlers
    program = (
        'import os, sys\n'
        'from koopman_ros.nodes.plant import PlantNode\n'
        'from koopman_ros.ros.process import run\n'
        'class Late:\n'
        f'    def __del__(self, kill=os.kill, own=(os.getpid(), {int(signal.SIGINT)})):\n'
        '        kill(*own)\n'
        'late = Late()\n'
        'def create():\n'
        f'    os.kill(os.getpid(), {int(signal.SIGINT)})\n'
        '    return PlantNode()\n'
        'sys.exit(run("plant", create))\n')
    process = ros.start('plant', command=(sys.executable, '-c', program))
    assert ros.wait_for_end(process) == 0
    assert 'Traceback' not in process.output()


def test_node_without_standard_streams_ends_cleanly(ros: Harness, tmp_path: Path) -> None:
    program = 'import sys; from koopman_ros.startup import trainer; sys.exit(trainer())'
    process = ros.start('trainer', {'output': tmp_path / 'bag.mcap'}, command=(
        'sh', '-c', 'exec "$@" <&- >&- 2>&-', 'sh', sys.executable, '-c', program))
    ros.meet('trainer')
    assert process.stop() == 0
    assert summary(tmp_path / 'bag.mcap').complete


def test_middleware_that_hangs_with_the_lock_held_does_not_keep_a_process(ros: Harness) -> None:
    program = (
        'import ctypes, os, signal, sys\n'
        'from koopman_ros import last_resort\n'
        'from koopman_ros.ros import process\n'
        'from koopman_ros.nodes.plant import PlantNode\n'
        'process._TAKE_DOWN_PATIENCE, last_resort._LATER = 0.1, 0.1\n'
        'class Hanging(PlantNode):\n'
        '    def destroy_node(self):\n'
        '        ctypes.PyDLL(None).sleep(3600)\n'
        'def create():\n'
        '    os.kill(os.getpid(), signal.SIGTERM)\n'
        '    return Hanging()\n'
        'sys.exit(process.run("plant", create))\n')
    process = ros.start('plant', command=(sys.executable, '-c', program))
    assert ros.wait_for_end(process) == 0
    assert 'in destroy_node' in process.output()


def test_a_process_that_runs_a_node_among_other_things_is_not_ended_by_force() -> None:
    program = (
        'import sys, time\n'
        'from koopman_ros import last_resort\n'
        'from koopman_ros.ros import process\n'
        'process._TAKE_DOWN_PATIENCE = 0.2\n'
        'last_resort._LATER = last_resort._AFTER = 0.0\n'
        'process._take_down("plant", None)\n'
        '# longer than it takes until a process is ended by force\n'
        'time.sleep(0.5)\n'
        'sys.exit(7)\n')
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, check=False,
                          timeout=TIMEOUT)
    assert (done.returncode, done.stderr) == (7, b'')


def test_middleware_that_hangs_does_not_keep_a_process(ros: Harness) -> None:
    program = (
        'import os, signal, sys, time\n'
        'from koopman_ros.ros import process\n'
        'from koopman_ros.nodes.plant import PlantNode\n'
        'process._TAKE_DOWN_PATIENCE = 0.3\n'
        'class Hanging(PlantNode):\n'
        '    def destroy_node(self):\n'
        '        time.sleep(3600.0)\n'
        'def create():\n'
        '    os.kill(os.getpid(), signal.SIGTERM)\n'
        '    os.kill(os.getpid(), signal.SIGTERM)\n'
        '    return Hanging()\n'
        'sys.exit(process.run("plant", create))\n')
    process = ros.start('plant', command=(sys.executable, '-c', program))
    assert ros.wait_for_end(process) == 0
    assert process.output().splitlines()[-1] == (
        'plant: the middleware does not shut down: left to the operating system')


# The time that they are told.


@pytest.mark.parametrize(('sec', 'nanosec'), [(-5, 0), (7, 4_000_000_000)])
def test_impossible_time_does_not_end_a_node(ros: Harness, sec: int, nanosec: int) -> None:
    process = ros.start('controller', {'use_sim_time': True})
    clock = ros.speak(Clock, '/clock', topics.CLOCK_QOS, to='controller')
    message = Clock()
    message.clock.sec, message.clock.nanosec = sec, nanosec

    def told() -> bool:
        clock.publish(message)
        return 'which is no time: ignored' in process.output()

    ros.wait_until(told)
    ros.meet('controller')
    # the true time is taken still
    clock.publish(Clock(clock=stamp_message(3 * NANOSECONDS)))
    ros.meet('controller')
    assert process.output().count('is no time') == 1


# Arguments.


@pytest.mark.parametrize('name', ['plant', 'controller', 'trainer', 'player', 'replay'])
def test_help_and_unknown_arguments(
        name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.answer(name, [name, '--ros-args', '-p', 'a:=1.0']) is None
    assert command_line.answer(name, [name, '--help']) == 0
    said = capsys.readouterr().out
    assert said.startswith(f'usage: ros2 run koopman_ros {name} ')
    assert 'exit codes: 0 ' in said
    assert f'config/{name}.yaml' in said
    assert all(f'\n  {row} ' in said for row in TABLES[name].rows)
    # rules as in ROS 1, which rcl still takes
    assert command_line.answer(name, [name, '__ns:=/unit']) is None
    assert command_line.answer(name, [name, 'speed:=2.0', 'more']) == 2
    assert capsys.readouterr().err == (
        f"{name}: unknown argument 'speed:=2.0': parameters are given as --ros-args -p "
        'name:=value; --help says more\n')


def test_help_is_read_as_far_as_somebody_wants_to() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, 'wb') as closed:
        done = subprocess.run([sys.executable, '-m', 'koopman_ros.nodes.plant', '--help'],
                              stdout=closed, stderr=subprocess.PIPE, check=False, timeout=TIMEOUT)
    assert (done.returncode, done.stderr) == (0, b'')


def test_program_answers_arguments_before_it_starts(ros: Harness) -> None:
    program = 'import sys; from koopman_ros.startup import plant; sys.exit(plant())'
    process = ros.start('plant', command=(sys.executable, '-c', program, '--speed=2.0'))
    assert process.wait() == 2
    assert 'started' not in process.output()


# Who can reach them.


@pytest.mark.parametrize(('environment', 'is_open'), [
    ({}, True),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, True),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'localhost'}, False),
    ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}, False),
    ({'ROS_LOCALHOST_ONLY': '1'}, False),
    ({'FASTRTPS_DEFAULT_PROFILES_FILE': '/somewhere/loopback_discovery.xml'}, False),
    ({'FASTRTPS_DEFAULT_PROFILES_FILE': '/somewhere/other.xml'}, True),
    ({'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce'}, False),
    ({'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Permissive'}, True),
])
def test_who_can_reach_a_node(environment: dict[str, str], is_open: bool) -> None:
    note = open_to_the_network({**environment, 'ROS_DOMAIN_ID': '7'})
    assert bool(note) == is_open
    if is_open:
        assert 'in ROS domain 7' in note
        assert 'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST' in note


def test_node_that_is_open_to_the_network_says_so_once(
        ros: Harness) -> None:
    # a node that believes itself open, on loopback
    program = (
        'import os, sys\n'
        'from koopman_ros.ros import process\n'
        'from koopman_ros.nodes.plant import PlantNode\n'
        'said = process.open_to_the_network\n'
        'process.open_to_the_network = lambda _: said({})\n'
        'sys.exit(process.run("plant", PlantNode))\n')
    process = ros.start('plant', command=(sys.executable, '-c', program))
    ros.meet('plant')
    assert process.stop() == 0
    assert process.output().count('can command this node') == 1


# Bad starts.


@dataclass(frozen=True)
class BadStart:
    """A node, the text of its parameter file, and the words that name what is wrong."""

    node: str
    text: str | None
    words: str


def _parameters(node: str, text: str) -> str:
    return f'/**/{node}:\n  ros__parameters:\n    {text}\n'


BAD_STARTS = {
    'missing file': BadStart('plant', None, 'Error opening YAML file'),
    'not YAML': BadStart('plant', 'plant: [1, 2\n foo: : bar\n', "Couldn't parse params file"),
    'no parameters in it': BadStart(
        'trainer', '/**:\n  speed: 1.0\n', 'Cannot have a value before ros__parameters'),
    'empty list': BadStart(
        'player', _parameters('player', 'topics: []'),
        'topics = [] must be a list of at least one string, e.g. [a, b]'),
    'another type': BadStart(
        'plant', _parameters('plant', 'speed: 1'), 'speed = 1 must be a double, e.g. 1.0'),
    'out of range': BadStart(
        'controller', _parameters('controller', 'coolant_max: 500.0'),
        'coolant_max = 500.0 degC must be in [-50, 150] degC'),
    'missing model': BadStart(
        'controller', _parameters('controller', 'model: /nowhere/lift.safetensors'),
        '/nowhere/lift.safetensors'),
    'truncated model': BadStart(
        'controller', _parameters('controller', 'model: {folder}/cut.safetensors'),
        'cut.safetensors'),
}


@pytest.fixture(scope='module')
def bad_starts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, NodeProcess]]:
    """Start a node in each of the bad ways, all at once."""
    folder = tmp_path_factory.mktemp('bad_starts')
    whole = model_path('reactor_nz4').read_bytes()
    (folder / 'cut.safetensors').write_bytes(whole[:len(whole) // 2])
    with isolated_domain() as environment:
        started = {}
        for name, case in BAD_STARTS.items():
            file = folder / f'{name}.yaml'
            if case.text is not None:
                file.write_text(case.text.replace('{folder}', str(folder)))
            started[name] = NodeProcess(case.node, {}, folder / f'{name}.log', environment,
                                        ('--params-file', str(file)))
        yield started
        for process in started.values():
            process.stop(signal.SIGKILL)


@pytest.mark.parametrize('name', BAD_STARTS)
def test_bad_start_says_why_in_one_line(bad_starts: dict[str, NodeProcess], name: str) -> None:
    process, case = bad_starts[name], BAD_STARTS[name]
    assert process.process.wait(TIMEOUT) == 1
    (line,) = process.output().splitlines()
    assert line.startswith(f'{case.node}: cannot start: ')
    assert case.words in line


# Where they are heard.


@pytest.mark.skipif('fastrtps' not in get_rmw_implementation_identifier(),
                    reason='the profile is one for Fast DDS')
def test_everything_stays_on_loopback_without_shared_memory(ros: Harness) -> None:
    process = ros.start('trainer', {'record_at_start': False})
    ros.meet('trainer')
    sockets = _udp_sockets(process.process.pid)
    assert len(sockets) >= 2
    assert set(sockets) == {'127.0.0.1'}
    assert '/dev/shm/fastrtps' not in Path(f'/proc/{process.process.pid}/maps').read_text()


def _udp_sockets(pid: int) -> list[str]:
    """Return the local addresses of the UDP sockets of a process."""
    links = [os.readlink(path) for path in Path(f'/proc/{pid}/fd').iterdir()]
    own = {link[len('socket:['):-1] for link in links if link.startswith('socket:[')}
    rows = [line.split() for table in ('udp', 'udp6')
            for line in Path(f'/proc/{pid}/net/{table}').read_text().splitlines()[1:]]
    # the address is written as hexadecimal in the order of the machine
    return [str(ipaddress.ip_address(bytes.fromhex(row[1].split(':')[0])[::-1]))
            for row in rows if row[9] in own]
