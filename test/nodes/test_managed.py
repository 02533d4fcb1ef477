# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Managed nodes across processes: nothing acts before it is active, and all can be taken down."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
import re
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import pytest
from sensor_msgs.msg import Temperature
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from koopman_ros.demo import reactor
from koopman_ros.event_log.records import parse, state_of
from koopman_ros.records import read_messages, summary
from koopman_ros.ros import topics
from koopman_ros.testing import Harness, NodeProcess
from support.controller_bench import reproduced
from support.nodes import change, seconds, temperature, value


def state(ros: Harness, node: str) -> str:
    return str(ros.call(GetState, f'{node}/get_state', GetState.Request()).current_state.label)


def parts(ros: Harness, node: str) -> set[str]:
    """Return topics and services of a node that only a configured one has."""
    always = {'/rosout', '/parameter_events', '/diagnostics', f'/{node}/transition_event',
              *(f'/{node}/{service}' for service in (
                  'change_state', 'get_state', 'get_available_states',
                  'get_available_transitions', 'get_transition_graph', 'describe_parameters',
                  'get_parameter_types', 'get_parameters', 'list_parameters', 'set_parameters',
                  'set_parameters_atomically', 'get_type_description'))}
    of = ros.node
    found = {name for look in (of.get_publisher_names_and_types_by_node,
                               of.get_subscriber_names_and_types_by_node,
                               of.get_service_names_and_types_by_node)
             for name, _ in look(node, '/')}
    return found - always


def started(ros: Harness, node: str, command: tuple[str, ...] | None = None, **parameters: Any
            ) -> NodeProcess:
    process = ros.start(node, {'autostart': False, **parameters}, command=command)
    assert state(ros, node) == 'unconfigured'
    ros.wait_until(lambda: node in ros.node.get_node_names())
    assert parts(ros, node) == set()
    return process


def stays_down(ros: Harness, node: str) -> None:
    assert state(ros, node) == 'unconfigured'
    ros.wait_until(lambda: parts(ros, node) == set())
    ros.statuses.clear()
    # answered after its next report would have come
    for _ in range(3):
        assert state(ros, node) == 'unconfigured'


def test_plant(ros: Harness) -> None:
    measured = ros.listen(Temperature, reactor.TEMPERATURE)
    process = started(ros, 'plant', speed=20.0)
    # neither by name nor by number, which managers use
    assert not change(ros, 'plant', 'activate')
    assert not change(ros, 'plant', number=Transition.TRANSITION_ACTIVATE)
    assert state(ros, 'plant') == 'unconfigured'

    assert change(ros, 'plant', number=Transition.TRANSITION_CONFIGURE)
    ros.wait_until(lambda: '/plant/reset' in parts(ros, 'plant'))
    still = ros.wait_for_status('plant: simulation', lambda s: s.message == 'inactive')
    # which moves nothing either
    assert ros.set_parameters('plant', **{'constants.feed_temperature': 10.0})[0].successful
    assert value(ros.wait_for_status('plant: simulation', lambda s: s is not still),
                 'temperature [degC]') == value(still, 'temperature [degC]')
    assert not measured

    assert change(ros, 'plant', 'activate')
    ros.wait_until(lambda: len(measured) > 20)
    assert change(ros, 'plant', 'deactivate')
    still = ros.wait_for_status('plant: simulation', lambda s: s.message == 'inactive')
    count = len(measured)
    ros.wait_for_status('plant: simulation', lambda s: s is not still)
    assert len(measured) == count
    # of which a busy machine skips some
    passed = seconds(measured[-1]) - seconds(measured[0])
    assert int(value(still, 'measurements')) == passed + 1

    reset = ros.node.create_client(Trigger, 'plant/reset')
    ros.wait_until(reset.service_is_ready)
    coolant = ros.node.create_publisher(Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)
    ros.wait_until(coolant.get_subscription_count)
    clean_up_under_way(ros, 'plant', lambda: coolant.publish(temperature(20.0, 0.0)),
                       lambda: reset.call_async(Trigger.Request()))
    stays_down(ros, 'plant')
    assert not [s for s in ros.statuses if s.name.startswith('plant')]
    # it begins afresh, with what was set meanwhile
    assert all(result.successful for result in ros.set_parameters('plant', **{
        'constants.feed_temperature': reactor.constant('feed_temperature'),
        'temperature.bias': 3.0}))
    assert change(ros, 'plant', 'configure')
    assert change(ros, 'plant', 'activate')
    ros.wait_until(lambda: len(measured) > count + 5)
    again = measured[count:]
    assert seconds(again[0]) == seconds(measured[0])
    assert again[0].temperature == pytest.approx(measured[0].temperature + 3.0)
    assert change(ros, 'plant', 'shutdown')
    assert ros.wait_for_end(process) == 0
    assert 'Traceback' not in process.output()


def clean_up_under_way(ros: Harness, node: str, *sent: Callable[[], object]) -> None:
    """Clean a node up while requests or messages are on their way to it, many of each."""
    client = ros.node.create_client(ChangeState, f'{node}/change_state')
    ros.wait_until(client.service_is_ready)
    ros.meet(node)
    asked = client.call_async(ChangeState.Request(transition=Transition(label='cleanup')))
    for _ in range(20):
        for send in sent:
            send()
    ros.wait_until(asked.done)
    assert asked.result().success
    assert state(ros, node) == 'unconfigured'


class Loop:
    """A controller that is measured by the test."""

    def __init__(self, ros: Harness) -> None:
        self.ros, self.time = ros, 0.0
        self.commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        self._sensor = ros.node.create_publisher(
            Temperature, reactor.TEMPERATURE, topics.LOOP_QOS)

    def measure(self) -> None:
        self.time += 1.0
        self._sensor.publish(temperature(42.85, self.time))

    def answered(self) -> bool:
        """Measure, and tell whether that is answered before the node does anything else."""
        self.measure()
        state(self.ros, 'controller')
        state(self.ros, 'controller')
        return bool(self.commands) and seconds(self.commands[-1]) == self.time


def test_controller(ros: Harness, tmp_path: Path) -> None:
    loop = Loop(ros)
    process = started(ros, 'controller', measurement_timeout=0.3)
    assert change(ros, 'controller', 'configure')
    ros.wait_until(lambda: '/coolant_setpoint' in parts(ros, 'controller'))
    ros.meet('controller')
    for _ in range(3):
        assert not loop.answered()
    ros.wait_for_status('controller: control', lambda s: s.message == 'inactive')
    assert not loop.commands

    assert change(ros, 'controller', 'activate')
    ros.wait_until(loop.answered)
    # silence: it holds its command, again and again
    ros.wait_until(lambda: len(loop.commands) > 4)
    assert change(ros, 'controller', 'deactivate')
    count = len(loop.commands)
    assert not loop.answered()
    first = ros.wait_for_status('controller: control', lambda s: s.message == 'inactive')
    ros.wait_for_status('controller: control', lambda s: s is not first)
    assert len(loop.commands) == count

    asked = ros.node.create_publisher(Temperature, reactor.SETPOINT, topics.LOOP_QOS)
    manual = ros.node.create_publisher(
        Temperature, reactor.MANUAL_COOLANT_SETPOINT, topics.LOOP_QOS)
    switch = ros.node.create_client(SetBool, 'controller/set_automatic')
    ros.wait_until(switch.service_is_ready)
    ros.wait_until(lambda: asked.get_subscription_count() and manual.get_subscription_count())
    clean_up_under_way(
        ros, 'controller', loop.measure, lambda: asked.publish(temperature(44.0, 0.0)),
        lambda: manual.publish(temperature(10.0, 0.0)),
        lambda: switch.call_async(SetBool.Request(data=False)))
    stays_down(ros, 'controller')
    assert not [s for s in ros.statuses if s.name.startswith('controller')]
    assert len(loop.commands) == count
    # code that was not named at the start
    for name, code in (('fallback_order', ['sdre', 'json:dumps']), ('estimator', 'this:s')):
        (result,) = ros.set_parameters('controller', **{name: code})
        assert 'at start-up: restart' in result.reason
    bad = tmp_path / 'bad.safetensors'
    bad.write_text('nonsense')
    for model, words in ((str(bad), str(bad)),
                         ('two_tanks', 'this controller was started for states temperature [K]')):
        assert ros.set_parameters('controller', model=model)[0].successful
        assert not change(ros, 'controller', 'configure')
        assert state(ros, 'controller') == 'unconfigured'
        ros.wait_until(lambda: parts(ros, 'controller') == set())
        *_, line = [line for line in process.output().splitlines() if '[ERROR]' in line]
        assert words in line

    assert ros.set_parameters(
        'controller', model='reactor_linear', measurement_timeout=0.0)[0].successful
    assert change(ros, 'controller', 'configure')
    assert change(ros, 'controller', 'activate')
    ros.meet('controller')
    ros.wait_until(loop.answered)
    assert value(ros.wait_for_status('controller: control', lambda s: s.message != 'inactive'),
                 'model') == 'reactor_linear'
    assert change(ros, 'controller', 'deactivate')
    assert change(ros, 'controller', 'shutdown')
    assert ros.wait_for_end(process) == 0
    assert 'Traceback' not in process.output()
    assert [re.sub('.* ', '', line) for line in process.output().splitlines() if re.search(
        r'\[INFO\].*activated', line)] == ['activated', 'deactivated'] * 2


def test_a_restarted_controller_continues_from_the_last_command(ros: Harness) -> None:
    """After an activation, by the records, too; an input that was measured long ago is none."""
    loop = Loop(ros)
    applied = ros.node.create_publisher(
        Temperature, reactor.COOLANT_TEMPERATURE, topics.LATCHED_QOS)
    applied.publish(temperature(15.0, 1.0))
    process = started(ros, 'controller', measurement_timeout=0.0)
    assert change(ros, 'controller', 'configure')
    assert change(ros, 'controller', 'activate')
    ros.meet('controller')
    ros.wait_until(loop.answered)
    assert ros.set_bool('controller/set_automatic', False).success
    ros.speak(Temperature, reactor.MANUAL_COOLANT_SETPOINT, to='controller').publish(
        temperature(8.0, 0.0))
    ros.wait_until(lambda: loop.answered() and loop.commands[-1].temperature == 8.0)
    records = ros.listen(String, topics.EVENT_LOG)
    ros.meet('controller')
    for way in ('deactivate', 'cleanup', 'configure', 'activate'), ('deactivate', 'activate'):
        count = len(loop.commands)
        for transition in way:
            if transition == 'activate':
                records.clear()
            assert change(ros, 'controller', transition)
        ros.meet('controller')
        ros.wait_until(loop.answered)
        assert loop.commands[count].temperature == pytest.approx(8.0, abs=1.0 + 1e-9)
        assert ros.set_bool('controller/set_automatic', False).success
        ros.wait_until(loop.answered)
    # what was commanded before may still act
    assert ros.set_parameters(
        'controller', **{'coolant_temperature.dead_time': 600.0})[0].successful
    for _ in range(3):
        ros.wait_until(loop.answered)
    assert change(ros, 'controller', 'deactivate')
    records.clear()
    assert change(ros, 'controller', 'activate')
    ros.wait_until(lambda: records)
    assert len(state_of(parse(records[0].data)).applied.times_ns) > 3
    ros.wait_until(loop.answered)
    # a measured input is where it starts from, also one that is not what was commanded
    assert change(ros, 'controller', 'deactivate')
    count = len(loop.commands)
    records.clear()
    assert change(ros, 'controller', 'activate')
    applied.publish(temperature(12.0, loop.time + 1.0))
    ros.meet('controller')
    ros.wait_until(loop.answered)
    assert loop.commands[count].temperature == pytest.approx(12.0, abs=1.0 + 1e-9)
    ros.wait_until(lambda: len(records) > 2)
    reproduced(records)
    assert process.stop() == 0
    assert 'Traceback' not in process.output()


def test_trainer(ros: Harness, tmp_path: Path) -> None:
    loop, bag = Loop(ros), tmp_path / 'run.mcap'
    process = started(ros, 'trainer', output=bag, experiment_timeout=60.0)
    assert change(ros, 'trainer', 'configure')
    words = 'trainer is not active: activate it first'
    for name in ('experiment', 'record'):
        response = ros.set_bool(f'trainer/{name}', True)
        assert (response.success, response.message) == (False, words)
    response = ros.trigger('trainer/train')
    assert (response.success, response.message) == (False, words)
    assert not bag.exists()

    def begin() -> Any:
        timer = ros.node.create_timer(0.02, loop.measure)
        response = ros.set_bool('trainer/experiment', True)
        assert response.success, response.message
        ros.wait_until(lambda: len({message.temperature for message in loop.commands}) > 5)
        return timer

    assert change(ros, 'trainer', 'activate')
    timer = begin()
    assert change(ros, 'trainer', 'deactivate')
    ros.node.destroy_timer(timer)
    ros.wait_until(lambda: ros.node.count_publishers(reactor.COOLANT_SETPOINT) == 0)
    ros.wait_until(lambda: loop.commands[-1].temperature == pytest.approx(18.85))
    count = len(loop.commands)
    assert all(abs(b.temperature - a.temperature) <= 1.0 + 1e-9
               for a, b in pairwise(loop.commands))
    assert summary(bag).complete
    last = list(read_messages(bag, ['/coolant_setpoint']))[-1].message
    assert (seconds(last), last.temperature) == (
        seconds(loop.commands[-1]), loop.commands[-1].temperature)
    ros.wait_for_status('trainer: recording', lambda s: s.message == 'not recording')
    ros.wait_for_status('trainer: experiment', lambda s: s.message == 'ended')
    assert ros.set_bool('trainer/record', True).message == words

    # while it waits for a first measurement
    assert change(ros, 'trainer', 'activate')
    client = ros.node.create_client(SetBool, 'trainer/experiment')
    ros.wait_until(client.service_is_ready)
    ros.meet('trainer')
    asked = client.call_async(SetBool.Request(data=True))
    ros.wait_until(lambda: ros.node.count_publishers(reactor.COOLANT_SETPOINT))
    assert change(ros, 'trainer', 'deactivate')
    ros.wait_until(asked.done)
    assert asked.result().message == 'rejected: it was stopped before the first measurement'

    record = ros.node.create_client(SetBool, 'trainer/record')
    ros.wait_until(record.service_is_ready)
    clean_up_under_way(ros, 'trainer', loop.measure,
                       lambda: record.call_async(SetBool.Request(data=True)))
    stays_down(ros, 'trainer')
    assert not [s for s in ros.statuses if s.name.startswith('trainer')]
    assert len(loop.commands) == count
    (result,) = ros.set_parameters('trainer', physical_model='this:s')
    assert 'at start-up: restart' in result.reason
    assert ros.set_parameters('trainer', **{'coolant_temperature.safe_value': 10.0})[0].successful
    assert change(ros, 'trainer', 'configure')
    assert change(ros, 'trainer', 'activate')
    timer = begin()
    # ends what is under way, too
    assert change(ros, 'trainer', 'shutdown')
    assert ros.wait_for_end(process) == 0
    ros.node.destroy_timer(timer)
    ros.wait_until(lambda: loop.commands[-1].temperature == pytest.approx(10.0))
    assert all(abs(b.temperature - a.temperature) <= 1.0 + 1e-9
               for a, b in pairwise(loop.commands))
    assert summary(tmp_path / 'run_3.mcap').complete
    assert 'Traceback' not in process.output()
