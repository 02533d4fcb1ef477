# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Life of the processes: clean ends, bad starts in one line, imports, and how they are kept."""

import contextlib
import ipaddress
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
from types import ModuleType

from builtin_interfaces.msg import Time
import pytest
from rclpy.utilities import get_rmw_implementation_identifier
from rosgraph_msgs.msg import Clock

from koopman_ros import __version__
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.nodes import controller, plant, player, trainer
from koopman_ros.parameters.table import as_yaml
from koopman_ros.records import summary
from koopman_ros.ros import topics
from koopman_ros.ros.node_descriptions import tables
from koopman_ros.ros.process import answer, open_to_the_network
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.testing import Harness, NodeProcess
from support.nodes import run_here, RunNode, TIMEOUT

TABLES = tables()


def importing(names: tuple[str, ...], act: str, main: str) -> tuple[str, ...]:
    """Return a command that runs what it imports as main, and acts when packages are imported."""
    return (sys.executable, '-c', (
        'import os, sys\n'
        'class Finder:\n'
        '    def find_spec(self, name, path=None, target=None):\n'
        f'        if name.split(".")[0] in {names} or name in {names}:\n'
        f'            {act}\n'
        'sys.meta_path.insert(0, Finder())\n'
        f'from koopman_ros.{main}\n'
        'sys.exit(main())\n'))


@pytest.mark.parametrize(('name', 'number', 'unneeded'), [
    ('plant', signal.SIGINT, ('torch',)),
    # which an early rclpy lacks
    ('controller', signal.SIGTERM, ('torch', 'rclpy.experimental')),
    ('trainer', signal.SIGINT, ('torch',))])
def test_a_signal_ends_a_node_cleanly_and_it_imports_no_unneeded_package(
        ros: Harness, tmp_path: Path, name: str, number: int, unneeded: tuple[str, ...]) -> None:
    # the plant is in the middle of a callback whenever the signal comes
    parameters = {'plant': {'speed': 0.0}, 'controller': {},
                  'trainer': {'output': tmp_path / 'bag'}}[name]
    process = ros.start(name, parameters, command=importing(
        unneeded, 'raise (ImportError if "." in name else AssertionError)(f"{name} is imported")',
        f'nodes.{name} import main'))
    ros.meet(name)
    # the profile is one for Fast DDS
    if 'fastrtps' in get_rmw_implementation_identifier():
        sockets = _udp_sockets(process.process.pid)
        assert len(sockets) >= 2
        assert set(sockets) == {'127.0.0.1'}
        assert '/dev/shm/fastrtps' not in Path(f'/proc/{process.process.pid}/maps').read_text()
    assert process.stop(number) == 0
    assert 'Traceback' not in process.output()
    said = {'plant': r'one-state reactor started: ', 'controller': 'reactor_nz4',
            'trainer': rf'recorded \d+ messages to {re.escape(str(tmp_path))}/bag\n'}[name]
    assert re.search(said, process.output())


def _udp_sockets(pid: int) -> list[str]:
    """Return the local addresses of the UDP sockets of a process."""
    links = []
    for path in Path(f'/proc/{pid}/fd').iterdir():
        # it may be closed already
        with contextlib.suppress(FileNotFoundError):
            links.append(os.readlink(path))
    own = {link[len('socket:['):-1] for link in links if link.startswith('socket:[')}
    rows = [line.split() for table in ('udp', 'udp6')
            for line in Path(f'/proc/{pid}/net/{table}').read_text().splitlines()[1:]]
    # the address is written as hexadecimal in the order of the machine
    return [str(ipaddress.ip_address(bytes.fromhex(row[1].split(':')[0])[::-1]))
            for row in rows if row[9] in own]


@pytest.mark.parametrize(('name', 'number', 'code'), [
    ('plant', signal.SIGTERM, 0), ('replay', signal.SIGINT, 130)])
def test_signal_while_a_program_loads_ends_it_without_a_word(
        ros: Harness, name: str, number: int, code: int) -> None:
    process = ros.start(name, command=importing(
        ('scipy',), f'os.kill(os.getpid(), {int(number)})',
        f'process_entry import {name} as main'))
    assert ros.wait_for_end(process) == code
    assert process.output() == ''


def test_signal_before_the_interpreter_is_up_and_arguments_are_answered_before_the_start(
        ros: Harness, tmp_path: Path) -> None:
    with NodeProcess('plant', {}, tmp_path / 'log', ros.environment) as process:
        assert process.stop(signal.SIGTERM) == 0
    assert process.output() == ''
    process = ros.start('plant', command=(
        *importing((), 'pass', 'process_entry import plant as main'), '--speed=2.0'))
    assert process.wait() == 2
    assert 'started' not in process.output()


# What happens at the end of a plant that gets a signal as it starts, and its last words.
ENDS = {
    # each signal is heard, by a thread, before the next one
    'signals one after the other': (
        'kill = os.kill\n'
        'os.kill = lambda *signal: (kill(*signal), time.sleep(0.2))\n', r'.*'),
    'a middleware that hangs with the lock held': (
        'process.take_down.__defaults__ = (0.1,)\n'
        'def destroy_node(self):\n'
        '    ctypes.PyDLL(None).sleep(3600)\n'
        'PlantNode.destroy_node = destroy_node\n', r'.*in destroy_node.*'),
}


@pytest.mark.parametrize('name', ENDS)
def test_signals_during_the_start_end_a_node_cleanly(shared_ros: Harness, name: str) -> None:
    before, words = ENDS[name]
    program = (
        'import ctypes, os, signal, sys, time\n'
        'from koopman_ros.ros import process\n'
        'from koopman_ros.nodes.plant import PlantNode\n'
        f'{before}'
        'def create():\n'
        '    os.kill(os.getpid(), signal.SIGTERM)\n'
        '    os.kill(os.getpid(), signal.SIGINT)\n'
        '    return PlantNode()\n'
        'sys.exit(process.run("plant", create))\n')
    plant = shared_ros.start('plant', command=(sys.executable, '-c', program))
    # code 1 where no Python could run
    assert shared_ros.wait_for_end(plant) == ('lock' in name)
    assert 'Traceback' not in plant.output()
    assert re.fullmatch(words, plant.output(), re.DOTALL)


SENDER = """
import os, signal, sys, time
import rclpy
from std_msgs.msg import String
from koopman_ros.ros import hosted, process, topics
rclpy.init()
node = hosted.HostedNode('sender', None)
node.last_messages_time = 20.0
endpoints = topics.EndpointMonitor(node, lambda: None)
publisher = endpoints.publish('text', String, topics.profile(200, reliable=True))
while not publisher.get_subscription_count():
    time.sleep(0.01)
os.kill(int(sys.argv[1]), signal.SIGSTOP)
for _ in range(200):
    publisher.publish(String(data=10_000 * '.'))
print('sent', flush=True)
if sys.argv[2] == 'node':
    process.take_down('sender', node, None, 30.0)
else:
    endpoints.destroy()
    print('destroyed', flush=True)
    signal.pause()
"""
RECEIVER = """
import rclpy
from std_msgs.msg import String
from koopman_ros.ros import topics
rclpy.init()
node = rclpy.create_node('receiver')
node.create_subscription(
    String, 'text', lambda _: print('.', end='', flush=True), topics.profile(200, reliable=True))
rclpy.spin(node)
"""


@pytest.mark.parametrize('ends', ['node', 'publisher'])
def test_the_last_messages_arrive_before_their_sender_ends(ros: Harness, ends: str) -> None:
    receiver = ros.start('receiver', command=(sys.executable, '-c', RECEIVER))
    sender = ros.start('sender', command=(
        sys.executable, '-c', SENDER, str(receiver.process.pid), ends))
    ros.wait_until(lambda: 'sent' in sender.output())
    # a sender that does not wait ends here, and what a stopped receiver has no room for is lost
    with contextlib.suppress(subprocess.TimeoutExpired):
        sender.process.wait(0.5)
    receiver.send(signal.SIGCONT)
    ros.wait_until(lambda: receiver.output().count('.') == 200)
    if ends == 'node':
        assert ros.wait_for_end(sender) == 0
    else:
        ros.wait_until(lambda: 'destroyed' in sender.output())
        sender.send(signal.SIGKILL)
    receiver.send(signal.SIGKILL)


def test_node_without_standard_streams_ends_cleanly(ros: Harness, tmp_path: Path) -> None:
    process = ros.start('trainer', {'output': tmp_path / 'bag.mcap'}, command=(
        'sh', '-c', 'exec "$@" <&- >&- 2>&-', 'sh',
        *importing((), 'pass', 'process_entry import trainer as main')))
    ros.meet('trainer')
    assert process.stop() == 0
    assert summary(tmp_path / 'bag.mcap').complete


def test_impossible_time_does_not_end_a_node(
        ros: Harness, run_node: RunNode, capfd: pytest.CaptureFixture[str]) -> None:
    run_node(controller.ControllerNode, {'use_sim_time': True})
    clock = ros.speak(Clock, '/clock', topics.CLOCK_QOS, to='controller')
    for sec, nanosec in ((-5, 0), (7, 4_000_000_000)):
        clock.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
        ros.meet('controller')
    assert 'ignored an invalid /clock message (sec -5, nanosec 0; ' in capfd.readouterr().err
    clock.publish(Clock(clock=stamp_message(3 * NANOSECONDS)))
    ros.meet('controller')


@pytest.mark.parametrize('name', TABLES)
def test_help_and_unknown_arguments(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert answer(name, [name, '--ros-args', '-p', 'a:=1.0']) is None
    assert answer(name, [name, '--version']) == 0
    assert capsys.readouterr().out == f'{__version__}\n'
    assert answer(name, [name, '--help']) == 0
    said = capsys.readouterr().out
    assert said.startswith(f'usage: ros2 run koopman_ros {name} ')
    assert 'exit codes: 0 ' in said
    assert f'config/{name}.yaml' in said
    assert all(f'\n  {row.name}: {as_yaml(row.default)}' in said and row.range_text in said
               for row in TABLES[name].rows.values())
    # rules as in ROS 1, which rcl still takes
    assert answer(name, [name, '__ns:=/unit']) is None
    assert answer(name, [name, 'speed:=2.0', 'more']) == 2
    assert capsys.readouterr().err == (
        f"{name}: unknown argument 'speed:=2.0': pass parameters as --ros-args -p "
        'name:=value; see --help\n')


@pytest.mark.parametrize(('name', 'given', 'code', 'said'), [
    ('controller', ['system:=two_tanks'], 0, 'subscribes to: level_1, level_2, '),
    ('plant', ['system:=two_tanks'], 0, '\n  level_1.measurement_noise: 0.0 m'),
    # the plant of a class of one's own, and a model of a system that has no file
    ('plant', ['system:=koopman_ros.plants.library.two_tanks:TwoTanks'], 0,
     'publishes: level_1, level_2, '),
    ('controller', ["system:=''", 'model:=two_tanks'], 0, 'publishes: pump_1_setpoint, '),
    ('panel', ["system:=''", 'model:=two_tanks'], 0, '\n  level_2.shown_unit: '),
    ('player', ['system:=none'], 0, '\n  bag: '),
    ('plant', ['system:=none'], 1, "plant 'none': choose"),
    ('controller', ['system:=none'], 1, "'none' has no model: name one"),
    ('trainer', ['system:=none'], 1, 'states_measured and inputs_commanded'),
])
def test_help_for_a_system(name: str, given: list[str], code: int, said: str,
                           capsys: pytest.CaptureFixture[str]) -> None:
    parameters = [part for value in given for part in ('-p', value)]
    for args in ([name, '--help', '--ros-args', *parameters],
                 [name, '--ros-args', *parameters, '--help']):
        assert answer(name, args) == code
        assert said in ''.join(capsys.readouterr())


def test_help_survives_a_closed_pipe() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, 'wb') as closed:
        done = subprocess.run([sys.executable, '-m', 'koopman_ros.nodes.plant', '--help'],
                              stdout=closed, stderr=subprocess.PIPE, check=False, timeout=TIMEOUT)
    assert (done.returncode, done.stderr) == (0, b'')


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


PARAMETERS = '/**:\n  ros__parameters:\n    '


# The text of a parameter file, and words that name what is wrong.
@pytest.mark.parametrize(('node', 'text', 'words'), [
    (plant, None, 'Error opening YAML file'),
    (plant, 'plant: [1, 2\n foo: : bar\n', "Couldn't parse params file"),
    (trainer, '/**:\n  speed: 1.0\n', 'Cannot have a value before ros__parameters'),
    (player, f'{PARAMETERS}topics: []\n', 'topics = [] must be a list of at least one string'),
    (controller, f'{PARAMETERS}coolant_temperature: {{max_disturbance: -1.0}}\n',
     'coolant_temperature.max_disturbance = -1.0 K must be in [0, 1000000000] K'),
    (controller, f'{PARAMETERS}model: /nowhere/lift.safetensors\n', '/nowhere/lift.safetensors'),
    (controller, f'{PARAMETERS}model: {{folder}}/cut.safetensors\n', 'cut.safetensors'),
])
def test_a_failed_start_gives_its_reason_in_one_line(
        tmp_path: Path, capfd: pytest.CaptureFixture[str], node: ModuleType, text: str | None,
        words: str) -> None:
    whole = model_path('reactor_nz4').read_bytes()
    (tmp_path / 'cut.safetensors').write_bytes(whole[:len(whole) // 2])
    if text is not None:
        (tmp_path / 'file.yaml').write_text(text.replace('{folder}', str(tmp_path)))
    assert run_here(node, '--params-file', str(tmp_path / 'file.yaml')) == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f'{node.__name__.rpartition(".")[2]}: cannot start: ')
    assert words in line
