# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a managed node does where its own work fails."""

from collections.abc import Iterator
from typing import Any

from lifecycle_msgs.srv import GetState
import pytest
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from koopman_ros.ros.diagnostics import Severity, TaskReport
from koopman_ros.ros.hosted import HostContext, wall_timer
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.rclpy_internals import events_executor
from koopman_ros.testing import Harness


class Failing(ManagedNode):
    """Make one of each, then raise what it is told to."""

    def __init__(self, context: Context) -> None:
        super().__init__('failing', context=context)
        self.failures: dict[str, BaseException] = {}

    def configure(self) -> None:
        self.create_publisher(String, 'mine', 1)
        self.create_subscription(String, 'other', lambda _: None, 1)
        self.create_service(Trigger, '~/service', lambda _, response: response)
        wall_timer(self, 1.0, lambda: None)
        self.diagnostics.add('task', lambda: TaskReport(Severity.OK, 'well'))
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


def state(node: ManagedNode) -> str:
    (service,) = (one for one in node.services if one.srv_type is GetState)
    return str(service.callback(GetState.Request(), GetState.Response()).current_state.label)


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


@pytest.mark.parametrize('where', ['configure', 'activate'])
def test_code_that_exits_in_a_transition_does_not_end_the_process(
        node: Failing, where: str) -> None:
    node.failures = {where: SystemExit(3)}
    with pytest.raises(RuntimeError, match='SystemExit: 3'):
        node.start()
    assert not node.active


@pytest.mark.parametrize('error', [OSError('the disk is full'), SystemExit(3)])
def test_node_that_cannot_leave_all_well_acts_no_more_all_the_same(
        node: Failing, error: BaseException) -> None:
    node.start()
    node.failures = {'deactivate': error}
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert (state(node), node.active) == ('inactive', False)
    assert node.rejection == 'failing is not active: activate it first'


def test_pending_callbacks_are_rejected_or_dropped_at_shutdown(shared_ros: Harness) -> None:
    """Under the executor of the loop's nodes, which takes what is queued in one go."""
    ros, heard = shared_ros, list[Any]()

    class Own(ManagedNode):
        def configure(self) -> None:
            for kind in range(2):
                self.create_subscription(String, f'words_{kind}', self.hear, 100)
            self.create_service(Trigger, '~/serve', self.serve)
            wall_timer(self, 1e-3, lambda: heard.append(self.configured()))

        def configured(self) -> bool:
            return state(self) == 'active'

        def hear(self, _: String) -> None:
            heard.append(self.configured())

        def serve(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            heard.append(self.configured())
            return response

    failures: list[BaseException] = []
    node = Own('own', context=ros.node.context, hosting=HostContext(1, failures.append))
    node.start()
    speakers = [ros.node.create_publisher(String, f'words_{kind}', 100) for kind in range(2)]
    client = ros.node.create_client(Trigger, 'own/serve')
    ros.wait_until(lambda: client.service_is_ready() and all(
        speaker.get_subscription_count() for speaker in speakers))
    for _ in range(20):
        for speaker in speakers:
            speaker.publish(String())
    assert all(speaker.wait_for_all_acked() for speaker in speakers)
    asked = [client.call_async(Trigger.Request()) for _ in range(3)]
    executor = events_executor(ros.node.context)
    executor.add_node(node)
    # what has come is queued, and one of it handled
    ros.wait_until(lambda: executor.spin_once(timeout_sec=0.01) or heard)
    node.trigger_deactivate()
    node.trigger_cleanup()
    for _ in range(50):
        executor.spin_once(timeout_sec=0.0)
    ros.wait_until(lambda: all(future.done() for future in asked))
    assert state(node) == 'unconfigured'
    executor.shutdown()
    node.destroy_node()
    for speaker in speakers:
        ros.node.destroy_publisher(speaker)
    ros.node.destroy_client(client)
    assert failures == []
    # no callback of what was taken down
    assert all(heard)
    assert all('not configured' in future.result().message for future in asked)


def test_time_that_is_simulated_meanwhile_stays_so(node: Failing) -> None:
    node.start()
    node.set_parameters([Parameter('use_sim_time', value=True)])
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS
    assert [heard.topic_name for heard in node.subscriptions] == ['/clock']


def test_the_process_does_not_end_before_the_answer_to_a_shutdown_is_out(
        shared_ros: Harness, node: Failing) -> None:
    node.start()
    assert node.trigger_shutdown() == TransitionCallbackReturn.SUCCESS
    assert not node.active
    assert node.exit_code is None
    shared_ros.node.executor.add_node(node)
    shared_ros.wait_until(lambda: node.exit_code is not None)
    assert node.exit_code == 0
