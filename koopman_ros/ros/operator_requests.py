# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Requests to a controller: set-points, manual commands, the mode, and values of a laboratory."""

from collections.abc import Callable, Mapping
import math
import time

import numpy as np
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from koopman_ros.control import events, Mode
from koopman_ros.core.arrays import Array
from koopman_ros.core.message_fields import base_name
from koopman_ros.core.units import NANOSECONDS, quantity_text
from koopman_ros.parameters.signal_topics import SignalTopics, words_of
from koopman_ros.ros import topics
from koopman_ros.ros.control_loop import ControlLoop
from koopman_ros.ros.signals import MeasuredInputs, SignalSample, SignalSubscriber

_SHOWN = 60.0  # s for which a request that was rejected or limited is a warning


class OperatorRequests:
    """
    Pass requests on to the control loop, and report which were rejected or limited.

    :param applied: measured inputs, from which a first manual command begins.
    :param changed: called after each request.
    :ivar setpoint_received: whether a set-point was accepted.
    """

    def __init__(self, node: Node, endpoints: topics.EndpointMonitor, wiring: SignalTopics,
                 loop: ControlLoop, applied: MeasuredInputs, changed: Callable[[], None]) -> None:
        self._log, self._loop, self._applied = node.get_logger(), loop, applied
        self._signals, self._changed = wiring.signals, changed
        self._words = words_of(wiring.signals)
        self._note, self._noted = '', 0.0
        self.setpoint_received = False
        # volatile, so that `ros2 topic pub` matches
        for places in (wiring.setpoints, wiring.joint_setpoints):
            SignalSubscriber(node, endpoints.subscribe, places, wiring.signals.states,
                             self._on_setpoints)
        self._manual = SignalSubscriber(
            node, endpoints.subscribe, wiring.manual, wiring.signals.inputs, self._on_manual)
        SignalSubscriber(node, endpoints.subscribe, wiring.late, wiring.signals.every,
                         self._on_analysis)
        node.create_service(SetBool, '~/set_automatic', self._on_set_automatic)
        node.create_service(Trigger, '~/clear_safe_state', self._on_clear_safe_state)

    @property
    def complaint(self) -> str:
        """Why the last request was rejected or limited, for a minute; or an empty string."""
        return self._note if time.monotonic() - self._noted < _SHOWN else ''

    @property
    def sender_gone(self) -> str:
        """Warning that manual commands have lost their sender, or an empty string."""
        state = self._loop.state
        return '' if (state.mode is not Mode.MANUAL or state.manual_input is None
                      or self._manual.published()) else (
            'the sender of the manual commands has gone: the last one stays applied; send another '
            'one, or switch to automatic mode')

    def _on_setpoints(self, received: SignalSample) -> None:
        # only a stamp of the sender schedules it
        stamp_ns = received.stamp_ns if received.stamped else 0
        several = len(self._signals.controlled) > 1
        before = self._loop.state.setpoint.requested
        if self._change(events.SetpointRequest(
                stamp_ns, np.array([*received.values.values()]),
                tuple(received.values) if several else None)):
            self.setpoint_received = True
            setpoint = self._loop.state.setpoint
            scheduled = any(entry[0] == stamp_ns for entry in setpoint.scheduled)
            when = f', effective from {stamp_ns / NANOSECONDS:.3f} s' if scheduled else ''
            moved = {} if before is None or setpoint.requested is None else {
                name: value for name, value, old in zip(
                    self._signals.controlled, setpoint.requested.tolist(), before.tolist(),
                    strict=True)
                if name not in received.values and abs(value - old) > 0.0}
            room = f'; {self._quantities(moved)} makes room, as it was not requested' * bool(moved)
            self._log.info(f'set-point {self._quantities(received.values)} accepted{when}{room}',
                           throttle_duration_sec=1.0)
        self._changed()

    def _quantities(self, values: Mapping[str, float]) -> str:
        """Write values of states, by name, with their units."""
        return ', '.join(f'{quantity_text(value, self._signals.states[name])} of {name}'
                         for name, value in values.items())

    def _on_analysis(self, received: SignalSample) -> None:
        for name, value in received.values.items():
            self._change(events.AnalysisValue(received.stamp_ns, name, value))
        self._changed()

    def _on_manual(self, received: SignalSample) -> None:
        state = self._loop.state
        held = state.command if state.manual_input is None else state.manual_input
        # the others stay
        requested = np.array([received.values.get(name, math.nan if held is None else held[i])
                              for i, name in enumerate(self._signals.inputs)])
        if state.command is None and (known := self._applied.latest) is not None:
            self._change(events.Initialisation(known))
        if self._change(events.ManualCommand(requested)) and (
                limited := self._limited(requested)):
            self._warn(limited)
        self._changed()

    def _on_set_automatic(self, request: SetBool.Request, response: SetBool.Response
                          ) -> SetBool.Response:
        mode = Mode.AUTOMATIC if request.data else Mode.MANUAL
        self._change(events.ModeChange(mode))
        response.success, response.message = True, f'{mode.value} mode'
        self._log.info(response.message)
        self._changed()
        return response

    def _on_clear_safe_state(self, _: Trigger.Request, response: Trigger.Response
                             ) -> Trigger.Response:
        response.success = self._change(events.ClearSafeState())
        response.message = 'safe state cleared' if response.success else self._note
        if response.success:
            self._log.info(response.message)
        self._changed()
        return response

    def _change(self, event: events.Event) -> bool:
        """Apply an event; return whether it is not rejected."""
        rejected = self._loop.change(event).rejected
        self._note = ''
        if rejected is not None:
            self._warn(f'request rejected: {self._words(rejected)}')
        return rejected is None

    def _warn(self, note: str) -> None:
        self._note, self._noted = note, time.monotonic()
        self._log.warning(note, throttle_duration_sec=1.0)

    def _limited(self, requested: Array) -> str:
        """Return the message for a manual command (n_u,) outside the limits, or ''."""
        within = self._loop.controller.tuning.limits.within(requested)
        return ', '.join(
            f'manual {base_name(name, unit)} {quantity_text(wanted, unit, ".2f")} is limited to '
            f'{quantity_text(limit, unit, ".2f")}'
            for (name, unit), wanted, limit in zip(
                self._signals.inputs.items(), requested.tolist(), within.tolist(), strict=True)
            if wanted != limit)
