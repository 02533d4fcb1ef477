# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Managed nodes: nothing acts before it is configured and active, and all can be taken down."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin

from koopman_ros.ros.node import LoopNode

# A parameter or a model that does not fit is a ValueError; rclpy raises RCLError for an unreadable
# parameter file, a RuntimeError whose class is private to the extension.
START_ERRORS = (OSError, ParameterException, RuntimeError, ValueError)


class ManagedNode(LifecycleNodeMixin, LoopNode):
    """
    A lifecycle node (design.ros2.org, managed nodes) that says how it is configured.

    What it makes between :meth:`configure` and :meth:`clean_up` is taken down by the latter.

    :ivar active: whether it may act.
    """

    active = False

    def __init__(self, name: str) -> None:
        LoopNode.__init__(self, name)
        LifecycleNodeMixin.__init__(self)
        self._failure: Exception | None = None
        self._kept = self._entities()
        # reports in each state
        assert self.diagnostics

    def start(self) -> None:
        """Configure and activate, as without a manager; raises what went wrong."""
        self._kept = self._entities()
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise self._failure or RuntimeError('a transition failed')

    def configure(self) -> None:
        """Make publishers, subscriptions, services and timers; raise what is in the way."""

    def activate(self) -> None:
        """Begin to act; raise what is in the way."""

    @property
    def refusal(self) -> str:
        """Why a service cannot begin anything now, or an empty string."""
        return '' if self.active else f'{self.get_name()} is not active: activate it first'

    def deactivate(self) -> None:
        """Act no more, and leave behind what is safe."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; what was made until an error is taken down again."""
        self._kept = self._entities()
        done = self._attempt(self.configure)
        if done != TransitionCallbackReturn.SUCCESS:
            self._clean_up()
        return done

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to act."""
        self.active = True
        done = self._attempt(self.activate)
        self.active = done == TransitionCallbackReturn.SUCCESS
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Act no more."""
        done = self._attempt(self.deactivate)
        self.active = False
        return done

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take down what was configured."""
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Act no more, and end the process."""
        if self.active:
            self._attempt(self.deactivate)
            self.active = False
        self.exit_code = 0
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to the unconfigured state."""
        self.active = False
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def _attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            work()
        except START_ERRORS as error:
            self._failure = error
            self.get_logger().error(' '.join(str(error).split()) or type(error).__name__)
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _clean_up(self) -> None:
        self.complete()
        self.forget_tables()
        self.diagnostics.clear()
        destroyers: tuple[Callable[[Any], Any], ...] = (
            self.destroy_timer, self.destroy_service, self.destroy_subscription,
            self.destroy_publisher)
        for destroy, entities in zip(destroyers, self._entities(), strict=True):
            for entity in entities:
                if not any(entity is kept for some in self._kept for kept in some):
                    destroy(entity)

    def _entities(self) -> tuple[list[Any], ...]:
        return (list(self.timers), list(self.services), list(self.subscriptions),
                list(self.publishers))
