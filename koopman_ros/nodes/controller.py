# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The controller node: answers each temperature measurement with a coolant set-point."""

from __future__ import annotations

import sys
import time

from koopman_ros.control import Controller, Mode, Report, State
from koopman_ros.nodes import topics, translation
from koopman_ros.nodes.controller_parameters import ControllerParameters, TABLE
from koopman_ros.nodes.diagnostics import DiagnosticsPublisher, Level, Status
from koopman_ros.nodes.messages import (
    NANOSECONDS,
    stamp_nanoseconds,
    temperature_message,
    to_celsius,
    to_kelvin,
)
from koopman_ros.nodes.model_loading import load_suitable, Situation
from koopman_ros.nodes.model_reload import ModelReload
from koopman_ros.nodes.process import LoopNode, run
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool, Trigger


class ControllerNode(LoopNode):
    """Carry messages to and from the control step; see the README for topics and services."""

    def __init__(self) -> None:
        super().__init__('controller', automatically_declare_parameters_from_overrides=True)
        parameters = TABLE.declare(self)
        self._settings = parameters
        self._models = ModelReload(
            self, load_suitable(parameters.model), self._situation, self._on_model)
        self._controller = Controller(self._models.in_force.model, parameters.settings())
        self._state = State()
        self._report = Report(Mode.AUTOMATIC)
        self._refused = ''
        self._measurements = self._late = 0
        self._temperature = np.nan
        self._last_heard = time.monotonic()
        self._setpoint_received = False

        self._commands = self.create_publisher(
            Temperature, topics.COOLANT_SETPOINT, topics.LOOP_QOS)
        self._active = self.create_publisher(
            Temperature, topics.ACTIVE_SETPOINT, topics.LATCHED_QOS)
        self._published_setpoint: float | None = None
        self._diagnostics = DiagnosticsPublisher(self, 'control', 'controller', self._status)
        # volatile, so that `ros2 topic pub` matches
        self.create_subscription(
            Temperature, topics.SETPOINT, self._on_setpoint, topics.LOOP_QOS)
        self.create_subscription(Temperature, topics.MANUAL_COOLANT_SETPOINT,
                                 self._on_manual_coolant_setpoint, topics.LOOP_QOS)
        # a sensor driver that publishes best effort needs this overridden to match
        self.create_subscription(
            Temperature, topics.TEMPERATURE, self._on_temperature, topics.LOOP_QOS,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.create_service(SetBool, '~/set_automatic', self._on_set_automatic)
        # a group of its own, or measurements would wait until a model is read
        self.create_service(Trigger, '~/reload_model', self._models.on_reload,
                            callback_group=MutuallyExclusiveCallbackGroup())
        TABLE.follow(self, parameters, self._on_parameters, self._models.accept)
        self.get_logger().info(self._models.in_force.about)

    def _on_temperature(self, message: Temperature) -> None:
        self._measurements += 1
        self._temperature = message.temperature
        self._last_heard = time.monotonic()
        self._state, command, self._report = translation.answer(
            self._controller, self._state, message)
        self._late += self._report.late
        self._commands.publish(temperature_message(
            command, message.header.stamp, message.header.frame_id))
        active = self._report.active_setpoint
        if active is not None and active[0] != self._published_setpoint:
            self._published_setpoint = float(active[0])
            self._active.publish(temperature_message(
                float(active[0]), message.header.stamp, message.header.frame_id))
        if self._report.clock_went_back:
            self.get_logger().warning('the measurement is older than the last one: time starts '
                                      'afresh', throttle_duration_sec=1.0)
        self._diagnostics.publish_if_changed()

    def _on_setpoint(self, message: Temperature) -> None:
        stamp_ns = stamp_nanoseconds(message.header.stamp)
        self._state, self._refused = translation.ask_setpoint(
            self._controller, self._state, message)
        if self._refused:
            self.get_logger().warning(self._refused, throttle_duration_sec=1.0)
        else:
            self._setpoint_received = True
            scheduled = any(entry[0] == stamp_ns for entry in self._state.setpoint.scheduled)
            when = f', holds from {stamp_ns / NANOSECONDS:.3f} s on' if scheduled else ''
            self.get_logger().info(f'set-point {message.temperature:.6g} degC accepted{when}',
                                   throttle_duration_sec=1.0)
        self._diagnostics.publish_if_changed()

    def _on_manual_coolant_setpoint(self, message: Temperature) -> None:
        self._state, self._refused = translation.ask_manual_coolant(
            self._controller, self._state, message)
        if self._refused:
            self.get_logger().warning(self._refused, throttle_duration_sec=1.0)
        self._diagnostics.publish_if_changed()

    def _on_set_automatic(self, request: SetBool.Request, response: SetBool.Response
                          ) -> SetBool.Response:
        mode = Mode.AUTOMATIC if request.data else Mode.MANUAL
        self._state = self._controller.set_mode(self._state, mode)
        self._refused = ''
        response.success, response.message = True, f'{mode.value} mode'
        self.get_logger().info(response.message)
        self._diagnostics.publish_if_changed()
        return response

    def _situation(self) -> Situation:
        return Situation(self._settings.settings(), self._state,
                         np.array([to_kelvin(self._temperature)]))

    def _on_parameters(self, parameters: ControllerParameters) -> None:
        self._settings = parameters
        self._models.take_over()
        self._on_model()

    def _on_model(self) -> None:
        self._controller = Controller(self._models.in_force.model, self._settings.settings())
        self._diagnostics.publish_if_changed()

    def _status(self) -> Status:
        report, model = self._report, self._controller.model
        mode = self._state.mode
        level, message = Level.OK, mode.value
        silent = time.monotonic() - self._last_heard
        if not self._measurements:
            level, message = Level.WARN, 'waiting for the first temperature measurement'
        elif silent > self._settings.measurement_timeout:
            level, message = Level.ERROR, (
                f'no measurement for more than {self._settings.measurement_timeout:g} s: the last '
                'command stays in force; check sensor and plant')
        elif report.problem:
            level, message = Level.ERROR, report.problem
        elif report.clock_stood_still:
            level, message = Level.WARN, (
                'the stamp of the measurement does not advance: the last command is held; stamp '
                'measurements with their time')
        elif self._refused:
            level, message = Level.WARN, f'request refused: {self._refused}'
        elif self._models.refused:
            level, message = Level.WARN, self._models.refused
        elif report.outside > 0.0:
            level, message = Level.WARN, (
                f'temperature is outside the trained range '
                f'[{to_celsius(model.states.lower[0]):.2f}, '
                f'{to_celsius(model.states.upper[0]):.2f}] degC: the model extrapolates')
        elif mode is Mode.AUTOMATIC and not self._setpoint_received:
            message += ', no set-point yet: the temperature first measured is held'
        elif report.at_range:
            message += ', coolant at its limit'
        elif report.at_rate:
            message += ', coolant at its rate limit'
        active = report.active_setpoint
        command = self._state.command
        return Status(level, message, {
            'mode': mode.value,
            'law': 'none' if report.law is None else report.law.value,
            **self._models.figures(),
            'temperature [degC]': float(self._temperature),
            'set-point [degC]': np.nan if active is None else to_celsius(float(active[0])),
            'coolant [degC]': np.nan if command is None else to_celsius(float(command[0])),
            'distance outside training box [half widths]': float(report.outside),
            'Riccati residual': float(report.residual),
            'gain norm': float(report.gain),
            'scheduled set-points': len(self._state.setpoint.scheduled),
            'measurements': self._measurements,
            'late measurements': self._late,
            'since last measurement [s]': silent,
        })


def main(args: list[str] | None = None) -> int:
    """Run the controller node."""
    return run('controller', ControllerNode, args)


if __name__ == '__main__':
    sys.exit(main())
