# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Managed (lifecycle) nodes: configuration, activation and clean-up."""

from __future__ import annotations

from collections.abc import Callable
import re
import traceback
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rosgraph_msgs.msg import Clock

from koopman_ros.core.plugins import contained
from koopman_ros.ros.hosted import wall_timer
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.rclpy_internals import end_lifecycle, take_request

# A parameter or a model that does not fit is a ValueError; rclpy raises RCLError for an unreadable
# parameter file, a RuntimeError whose class is private to the extension.
START_ERRORS = (OSError, ParameterException, RuntimeError, ValueError)
_FAREWELL = 0.5  # s
# Error of rcl for a text that is empty after the shell removed its quotes.
_EMPTY_TEXT = re.compile(r"parameter override rule: '-p ([^' ]+:=)'")


class ManagedNode(LifecycleNodeMixin, LoopNode):
    """
    A lifecycle node (design.ros2.org, managed nodes) that reports errors of its transitions.

    The clean-up destroys every entity that was created since :meth:`configure`.

    :ivar active: whether the node is in the active state.
    """

    active = False

    def __init__(self, name: str, **options: Any) -> None:
        LoopNode.__init__(self, name, **options)
        LifecycleNodeMixin.__init__(self)
        self._failure: Exception | None = None
        self._alone = False  # whether only an exception reports a failure
        # reports in each state
        assert self.diagnostics
        self._kept = self._entities()
        (transitions,) = (one for one in self.services if one.srv_type is ChangeState)
        change = transitions.callback
        transitions.callback = lambda request, response: self._on_change(
            change, request, response)

    def destroy_node(self) -> None:
        """Take the node down with its lifecycle, which would keep its name on the network."""
        super().destroy_node()
        end_lifecycle(self)

    def start(self) -> None:
        """Configure and activate, as without a manager; raises the error."""
        self._alone = True
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                assert self._failure is not None
                raise self._failure
        self._alone = False

    def configure(self) -> None:
        """Create publishers, subscriptions, services and timers; raise an error to reject."""

    def activate(self) -> None:
        """Begin to act; raise an error to reject."""

    @property
    def rejection(self) -> str:
        """Reason to reject a request of a service, or an empty string."""
        return '' if self.active else f'{self.get_name()} is not active: activate it first'

    def deactivate(self) -> None:
        """Stop acting, and leave the plant safe."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; destroy its objects if that fails."""
        done = self._attempt(self.configure)
        if done != TransitionCallbackReturn.SUCCESS:
            self._clean_up()
        return done

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to act."""
        self.active = True
        done = self._attempt(self.activate)
        self.active = done == TransitionCallbackReturn.SUCCESS
        if self.active:
            self.get_logger().info('activated')
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting, also if :meth:`deactivate` fails."""
        self.active = False
        self._attempt(self.deactivate)
        self.get_logger().info('deactivated')
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy the configured objects."""
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting, and end the process."""
        if self.active:
            self.on_deactivate(state)
        # the response goes out first: it would be lost with the service
        wall_timer(self, _FAREWELL, self._end)
        return TransitionCallbackReturn.SUCCESS

    def _end(self) -> None:
        self.exit_code = 0

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to the unconfigured state."""
        self.active = False
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def _on_change(self, change: Callable[..., ChangeState.Response],
                   request: ChangeState.Request, response: ChangeState.Response
                   ) -> ChangeState.Response:
        try:
            return change(request, response)
        except RuntimeError as error:
            # in rclpy an invalid transition would end the process
            self.get_logger().error(f'this transition is not possible now: {one_line(error)}')
            response.success = False
            return response

    def _attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            work()
        except BaseException as caught:
            # code of one's own may raise SystemExit, which would end all nodes of the process
            text = contained(caught)
            error = caught if isinstance(caught, Exception) else RuntimeError(text)
            # rclpy does not report the exception
            self._failure = error
            expected = isinstance(error, START_ERRORS)
            if not self._alone:
                self.get_logger().error(
                    one_line(error) if expected else traceback.format_exc())
            if not expected:
                raise
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _clean_up(self) -> None:
        self.complete()
        self._reject_requests()
        self.forget_tables()
        self.diagnostics.clear()
        self.await_delivery(self.publishers)
        destroyers: tuple[Callable[[Any], Any], ...] = (
            self.destroy_timer, self.destroy_service, self.destroy_subscription,
            self.destroy_publisher)
        for destroy, entities, kept in zip(destroyers, self._entities(), self._kept, strict=True):
            for entity in entities:
                if not any(entity is other for other in kept):
                    destroy(entity)

    def _reject_requests(self) -> None:
        """Answer the requests that wait at the services to be destroyed."""
        for service in self.services:
            if any(service is kept for kept in self._kept[1]):
                continue
            kind: Any = service.srv_type
            while (header := take_request(service)) is not None:
                response = kind.Response()
                if hasattr(response, 'message'):
                    response.message = (
                        f'{self.get_name()} is not configured: configure and activate it first')
                service.send_response(response, header)

    def _entities(self) -> tuple[list[Any], ...]:
        # rclpy subscribes to the time whenever `use_sim_time` is set
        subscriptions = [one for one in self.subscriptions if one.msg_type is not Clock]
        return (list(self.timers), list(self.services), subscriptions,
                list(self.publishers))


def one_line(error: BaseException) -> str:
    """Return the message of an error, which rcl repeats over several lines."""
    text = str(error).split(', at ./')[0].split(', at /')[0]
    text = ' '.join(text.split()) or type(error).__name__
    if empty := _EMPTY_TEXT.search(text):
        text += f'; an empty string needs nested quotes: -p "{empty[1]}\'\'"'
    return text
