# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a managed node does where its own work fails."""

from collections.abc import Iterator
import time
from typing import Any

import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.node import Level, Status, wall_timer
from koopman_ros.testing import Harness
from support.nodes import TIMEOUT


class Failing(ManagedNode):
    """Make one of each, then raise what it is told to."""

    def __init__(self, context: Context) -> None:
        super().__init__('failing', context=context)
        self.failures: dict[str, Exception] = {}

    def configure(self) -> None:
        self.create_publisher(String, 'mine', 1)
        self.create_subscription(String, 'other', lambda _: None, 1)
        self.create_service(Trigger, '~/service', lambda _, response: response)
        wall_timer(self, 1.0, lambda: None)
        self.diagnostics.add('task', lambda: Status(Level.OK, 'well'))
        self._fail('configure')

    def activate(self) -> None:
        self._fail('activate')

    def deactivate(self) -> None:
        self._fail('deactivate')

    def _fail(self, where: str) -> None:
        if where in self.failures:
            raise self.failures[where]


@pytest.fixture
def node(shared_ros: Harness) -> Iterator[Failing]:
    made = Failing(shared_ros.node.context)
    yield made
    made.destroy_node()


def state(node: Failing) -> str:
    return str(node._state_machine.current_state[1])


def parts(node: Failing) -> tuple[set[Any], ...]:
    return (*map(set, (node.publishers, node.subscriptions, node.services, node.timers)),
            set(node.diagnostics.tasks))


@pytest.mark.parametrize(('error', 'answer'), [
    (OSError('no disk'), TransitionCallbackReturn.FAILURE),
    # a mistake in the program
    (KeyError('x'), TransitionCallbackReturn.ERROR)])
@pytest.mark.parametrize('where', ['configure', 'activate'])
def test_start_that_fails_leaves_nothing_half_made(
        node: Failing, where: str, error: Exception, answer: TransitionCallbackReturn) -> None:
    before, node.failures = parts(node), {where: error}
    with pytest.raises(type(error)) as raised:
        node.start()
    # itself, with the place that it comes from
    assert raised.value is error
    assert not node.active
    known = where == 'activate' and isinstance(error, OSError)
    assert state(node) == ('inactive' if known else 'unconfigured')
    assert (parts(node) == before) is not known
    if known:
        assert node.trigger_activate() == answer
        assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
        assert parts(node) == before
    elif where == 'configure':
        assert node.trigger_configure() == answer
        assert parts(node) == before

    node.failures = {}
    node.start()
    assert (state(node), node.active) == ('active', True)
    assert all(len(now) == len(then) + 1 for now, then in zip(parts(node), before, strict=True))


def test_node_that_cannot_leave_all_well_acts_no_more_all_the_same(node: Failing) -> None:
    node.start()
    node.failures = {'deactivate': OSError('the disk is full')}
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert (state(node), node.active) == ('inactive', False)
    assert node.refusal == 'failing is not active: activate it first'


def test_time_that_is_simulated_meanwhile_stays_so(node: Failing) -> None:
    node.start()
    node.set_parameters([Parameter('use_sim_time', value=True)])
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    assert [heard.topic_name for heard in node.subscriptions] == ['/clock']


def test_the_process_does_not_end_before_the_answer_to_a_shutdown_is_out(node: Failing) -> None:
    node.start()
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS
    assert not node.active
    assert node.exit_code is None
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    deadline = time.monotonic() + TIMEOUT
    while node.exit_code is None and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=1.0)
    executor.shutdown()
    assert node.exit_code == 0
