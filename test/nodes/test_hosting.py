# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Many loops in one process: each with what is its own, one failing without the others."""

from collections.abc import Sequence
from pathlib import Path
import shutil
import signal
import sys

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import pytest
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.core.paths import model_path
from koopman_ros.demo import reactor
from koopman_ros.nodes import controller
from koopman_ros.parameters.signal_topics import bundled_plants
from koopman_ros.ros import topics
from koopman_ros.testing import Harness, NodeProcess
from support.controller_bench import STEADY
from support.nodes import change, run_here, seconds, temperature, value

SAFE = 10.0  # degC
STRIKES = STEADY + 1.0  # degC at which a callback raises, in the controller below
STRUCK_AT = STRIKES + 273.15  # K

# A watchdog that is five times as quick as it is, and a control step with an error in it.
STRUCK = f"""
import sys
from koopman_ros.ros import watchdog
watchdog.PERIOD = 0.02
from koopman_ros.nodes import controller
from koopman_ros.control import events
apply = events.apply
def struck(*args):
    event = args[2]
    if isinstance(event, events.Measurement) and abs(event.measured[0] - {STRUCK_AT}) < 0.1:
        raise SystemExit('struck')
    return apply(*args)
events.apply = struck
sys.exit(controller.main())
"""

PARAMETERS = """
/line/r1/controller:
  ros__parameters:
    hold_timeout: 30.0
/line/r2/controller:
  ros__parameters:
    model: {model}
    hold_timeout: 40.0
/line/bad/controller:
  ros__parameters:
    model: nowhere.safetensors
/line/exits/controller:
  ros__parameters:
    fallback_order: ['sdre', 'hosted_exits:Law']
/line/struck/controller:
  ros__parameters:
    measurement_timeout: 0.3
    hold_timeout: 0.2
    coolant_temperature.safe_value: {safe}
    coolant_temperature.rate_limit: 1000.0
"""


def start(ros: Harness, node: str, loops: Sequence[str], *arguments: str,
          command: tuple[str, ...] | None = None) -> NodeProcess:
    file = ros.folder / f'{node}_loops.txt'
    file.write_text('\n'.join(loops))
    return ros.start(node, arguments=(*arguments, '--', '--loops', str(file)), command=command)


class Loop:
    """The sensor of a hosted loop, and what is commanded there."""

    def __init__(self, ros: Harness, namespace: str) -> None:
        self._ros, self.node, self._time = ros, f'{namespace}/controller', 0.0
        self.commands = ros.listen(Temperature, f'{namespace}/{reactor.COOLANT_SETPOINT}')
        self.active = ros.listen(Temperature, f'{namespace}/{reactor.ACTIVE_SETPOINT}')
        self.setpoint = ros.node.create_publisher(
            Temperature, f'{namespace}/{reactor.SETPOINT}', topics.LOOP_QOS)
        self.thermometer = ros.speak(
            Temperature, f'{namespace}/{reactor.TEMPERATURE}', to=self.node)

    def measure(self, celsius: float = STEADY) -> None:
        self._time += 1.0
        self.thermometer.publish(temperature(celsius, self._time))

    def answered(self) -> bool:
        return any(seconds(command) == self._time for command in self.commands)

    def measure_and_wait(self) -> None:
        self.measure()
        self._ros.wait_until(self.answered)


def test_loops_of_a_process(ros: Harness, tmp_path: Path) -> None:
    model = tmp_path / 'own.safetensors'
    shutil.copy(model_path('reactor_nz3'), model)
    parameters = tmp_path / 'site.yaml'
    parameters.write_text(PARAMETERS.format(model=model, safe=SAFE))
    (tmp_path / 'hosted_exits.py').write_text('raise SystemExit(3)')
    process = start(
        ros, 'controller', ('line/r1', 'line/bad', 'line/exits', '/line/r2', 'line/struck'),
        '--params-file', str(parameters), command=(
            sys.executable, '-c', f'import sys; sys.path.insert(0, {str(tmp_path)!r})\n{STRUCK}'))
    r1, r2, struck = (Loop(ros, f'/line/{name}') for name in ('r1', 'r2', 'struck'))

    # its own parameters and model
    assert ros.get_parameters(r1.node, 'model', 'hold_timeout') == [reactor.MODEL, 30.0]
    assert ros.get_parameters(r2.node, 'model', 'hold_timeout') == [str(model), 40.0]
    assert ros.set_parameters(r2.node, hold_timeout=50.0)[0].successful
    assert ros.get_parameters(r1.node, 'hold_timeout') == [30.0]

    # the one that cannot start keeps no other from it
    ros.wait_for_status('controller_host: loops', lambda s: s.level == DiagnosticStatus.ERROR and (
        s.message.startswith('3 of 5 loops are running, 2 failed: /line/bad: cannot start: ')
        and 'SystemExit' in s.message
        and value(s, 'to be started') == '0'))
    assert ('controller', '/line/bad') not in ros.node.get_node_names_and_namespaces()
    for loop in (r1, r2, struck):
        loop.measure_and_wait()

    # set-points are independent
    r1.setpoint.publish(temperature(STEADY + 2.0))
    r1.measure_and_wait()
    ros.wait_until(lambda: r1.active[-1].temperature > STEADY + 0.1)
    r2.measure_and_wait()
    ros.wait_until(lambda: r2.active)
    assert [message.temperature for message in r2.active] == pytest.approx([STEADY])

    # an asynchronous service
    assert ros.trigger(f'{r2.node}/reload_model').success
    model.write_bytes(b'no model')
    assert not ros.trigger(f'{r2.node}/reload_model').success

    # an error in a callback ends the loop, whose watchdog goes to the safe input
    struck.measure(STRIKES)
    ros.wait_for_status('controller_host: loops', lambda s: (
        '/line/struck: stopped: struck' in s.message and value(s, 'running') == '2'))
    before = len(struck.commands)
    ros.wait_until(lambda: len(struck.commands) > before
                   and struck.commands[-1].temperature == pytest.approx(SAFE))
    r1.measure_and_wait()
    r2.measure_and_wait()
    assert 'SystemExit' in process.output()

    # the lifecycle is one's own
    assert change(ros, r2.node, 'deactivate')
    count = len(r2.commands)
    r2.measure()
    r1.measure_and_wait()
    ros.meet(r2.node)
    assert len(r2.commands) == count
    assert change(ros, r2.node, 'activate')
    r2.measure_and_wait()
    assert change(ros, r2.node, 'shutdown')
    ros.wait_until(lambda: ('controller', '/line/r2') not in (
        ros.node.get_node_names_and_namespaces()))
    r1.measure_and_wait()
    # who was shut down has not failed
    ros.wait_for_status('controller_host: loops', lambda s: (
        value(s, 'running'), value(s, 'failed')) == ('1', '3'))
    assert process.stop() == 0


def test_a_clean_up_while_a_recorder_comes_ends_no_loop(ros: Harness) -> None:
    """Both wait for the process, as they do for a busy one."""
    process = start(ros, 'controller', ('a', 'b'))
    loop = Loop(ros, '/b')
    client = ros.node.create_client(ChangeState, '/a/controller/change_state')
    ros.wait_until(client.service_is_ready)
    for _ in range(4):
        ros.meet('/a/controller')
        assert change(ros, '/a/controller', 'deactivate')
        process.process.send_signal(signal.SIGSTOP)
        asked = client.call_async(ChangeState.Request(transition=Transition(label='cleanup')))
        recorder = ros.node.create_subscription(String, '/a/event_log', lambda _: None, 10)
        process.process.send_signal(signal.SIGCONT)
        ros.wait_until(asked.done)
        assert asked.result().success
        loop.measure_and_wait()
        ros.node.destroy_subscription(recorder)
        assert change(ros, '/a/controller', 'configure')
        assert change(ros, '/a/controller', 'activate')
    assert process.stop() == 0
    assert 'Traceback' not in process.output()


# A node with a callback of rclpy's own, which nothing guards.
UNGUARDED = """
import sys
from rclpy.node import Node
from koopman_ros.nodes import controller
class Own(controller.ControllerNode):
    def configure(self):
        super().configure()
        if self.get_namespace() == '/a':
            Node.create_timer(self, 0.05, lambda: 1 / 0)
controller.ControllerNode = Own
sys.exit(controller.main())
"""


def test_what_rclpy_raises_ends_no_loop(ros: Harness) -> None:
    process = start(ros, 'controller', ('a', 'b'), command=(sys.executable, '-c', UNGUARDED))
    loop = Loop(ros, '/b')
    ros.wait_until(lambda: 'ZeroDivisionError' in process.output())
    for _ in range(3):
        loop.measure_and_wait()
    assert process.stop() == 0


def test_plants_and_controllers_of_a_site(ros: Harness) -> None:
    loops = ('hall_1/a', 'hall_2/a')
    commands = [ros.listen(Temperature, f'/{loop}/{reactor.COOLANT_SETPOINT}') for loop in loops]
    start(ros, 'plant', loops, '-p', 'sample_period:=0.1')
    start(ros, 'controller', loops)
    ros.wait_until(lambda: all(len(own) > 3 for own in commands))
    assert ros.trigger('/hall_2/a/plant/reset').success


def test_program_of_which_no_loop_is_left_ends(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'loops.txt').write_text('a\nb')
    loops = ('--', '--loops', str(tmp_path / 'loops.txt'))
    for given, words, count in (
            (('-p', 'model:=nowhere.safetensors'),
             'cannot start: no model file at nowhere.safetensors', 2),
            (('-r', '__ns:=/elsewhere'),
             'controller: cannot start: -r __ns:=/elsewhere would apply to all loops', 1)):
        assert run_here(controller, *given, *loops) == 1
        assert capfd.readouterr().err.count(words) == count


def test_shipped_plants_start_without_a_warning(ros: Harness, tmp_path: Path) -> None:
    """All by their own parameter files, in one process: their safe inputs suit their models."""
    plants = bundled_plants()
    parameters = tmp_path / 'site.yaml'
    parameters.write_text('\n'.join(
        f'/{name}/controller:\n  ros__parameters: {{system: {name}}}' for name in plants))
    process = start(ros, 'controller', plants, '--params-file', str(parameters))
    for name in plants:
        assert ros.get_parameters(f'/{name}/controller', 'system') == [name]
        ros.wait_for_status(f'{name}/controller: control', lambda s: (
            value(s, 'safe input') == 'within reach'))
    assert 'WARN' not in process.output()
