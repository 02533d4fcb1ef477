# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The plant node: a simulated reactor that publishes its temperature and takes a coolant."""

from dataclasses import replace
from enum import Enum
import math
import sys
import time

import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, Temperature
from std_srvs.srv import Trigger

from koopman_ros import plants
from koopman_ros.parameters.plant import PlantParameters, REACTORS, TABLE
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, stamp_nanoseconds, temperature_message
from koopman_ros.ros.node import DiagnosticsPublisher, Level, LoopNode, Status, wall_timer
from koopman_ros.ros.process import run
from koopman_ros.units import LAST_STAMP_SECONDS, NANOSECONDS, seconds_text, to_celsius, to_kelvin

_POLL_PERIOD = 0.01  # s; for what no message announces
_LAST_STAMP_NS = (LAST_STAMP_SECONDS + 1) * NANOSECONDS - 1
_SILENCE = 3.0  # s without a command, and five periods, after which somebody should know


class Phase(Enum):
    """What the plant is doing; the value is the sentence an operator reads."""

    WAITING = 'waiting for the loop: no controller yet'
    RUNNING = 'running'
    FINISHED = 'finished: the duration is over'
    OUT_OF_STAMPS = (f'finished: the stamps of messages end at {LAST_STAMP_SECONDS} s; start the '
                     'plant again with a smaller start_time')
    TRIPPED = 'stopped'


class PlantNode(LoopNode):
    """Run a reactor in time; docs/interfaces.md has its topics and services."""

    def __init__(self) -> None:
        super().__init__('plant')
        self._settings = parameters = self.declare_table(TABLE)
        system = self._build(parameters)
        self._real_time = parameters.speed == 1.0 and not parameters.lockstep
        self._period_ns = round(parameters.sample_period * NANOSECONDS)
        self._start_ns = round(parameters.start_time * NANOSECONDS)
        self._plant = self._initial(system, self._start_ns)
        self._phase, self._trip = Phase.WAITING if parameters.lockstep else Phase.RUNNING, ''
        self._sample = 0  # number of the next measurement
        self._answered = True  # whether the last measurement has its command
        self._commands = self._rejected = self._missed = self._foreign = 0
        self._waiting_in_vain, self._rejection = False, ''
        self._wall_start = self._wall_published = self._last_command = time.monotonic()

        # the subscription first: a controller that hears the measurement has then seen it, too
        self._matching = topics.Matching(
            self, lambda: self._diagnostics.publish_if_changed(), topics.SINGLE)
        self._command_subscription = self._matching.subscribe(
            topics.COOLANT_SETPOINT, self._on_command)
        self._clock_publisher = self.create_publisher(*topics.of(topics.CLOCK)) if (
            parameters.publish_clock and not self._real_time) else None
        self._concentration = self.create_publisher(*topics.of(topics.CONCENTRATION)) if (
            system.n_x == 2) else None
        # the temperature last: who has found it has found the coolant, too
        self._coolant = self._matching.publish(topics.COOLANT_TEMPERATURE)
        self._temperature = self._matching.publish(topics.TEMPERATURE)
        self._diagnostics = DiagnosticsPublisher(
            self, 'simulation', parameters.reactor, self._status)
        self.create_service(Trigger, '~/reset', self._on_reset)
        wall_period = parameters.sample_period / (parameters.speed or math.inf)
        if parameters.lockstep:
            wall_timer(self, _POLL_PERIOD, self._on_poll)
            if parameters.speed:
                wall_timer(self, wall_period, self._step_in_lockstep)
        else:
            self._tick = wall_timer(self, wall_period, self._step_in_time)
        self.follow_table(TABLE, parameters, self._on_parameters)
        pace = ('as fast as it can' if not parameters.speed else 'in real time'
                if self._real_time else f'{parameters.speed:g} times as fast as the clock')
        start = '' if self._real_time else f' from {seconds_text(self._start_ns)} s on'
        lockstep = (f', in lock-step: it begins with {parameters.lockstep_subscribers} '
                    'subscribers and a controller') if parameters.lockstep else ''
        self.get_logger().info(f'{parameters.reactor} reactor started: a measurement every '
                               f'{parameters.sample_period:g} s{start}, {pace}{lockstep}')

    def _build(self, parameters: PlantParameters) -> plants.ControlAffineSystem:
        """Build the reactor, which starts from its steady state if it has one."""
        build = REACTORS[parameters.reactor]
        try:
            return build(parameters.constants())
        except plants.EquilibriumError as error:
            nominal = build().nominal_state
            self.get_logger().warning(
                f'{error}; the plant starts at {to_celsius(float(nominal[-1])):.3f} degC instead')
            return build(parameters.constants(), nominal_state=nominal)

    def _initial(self, system: plants.ControlAffineSystem, time_ns: int) -> plants.Process:
        x, u = system.nominal_state.copy(), system.nominal_input
        x[-1] += self._settings.initial_temperature_offset
        return plants.Process(system, time_ns, x, u, self._settings.actuator(), u)

    def _now_ns(self) -> int:
        """Return the plant time that the wall clock stands for."""
        elapsed = time.monotonic() - self._wall_start
        return self._start_ns + round(elapsed * self._settings.speed * NANOSECONDS)

    def _step_in_time(self) -> None:
        if self._sample == 0:
            # time begins now, and the next tick is in a period from now: after a first one that
            # was late, all stamps would be ahead of the clock
            self._tick.reset()
            self._wall_start = time.monotonic()
            if self._real_time:
                self._start_ns = time.time_ns()
                self._plant = replace(self._plant, time_ns=self._start_ns)
        if self._phase is not Phase.RUNNING:
            return
        if self._settings.speed:
            # a timer skips the periods that it missed, and so do the samples
            due = round((self._now_ns() - self._start_ns) / self._period_ns)
            self._sample = max(self._sample, due)
        self._measure()

    def _on_poll(self) -> None:
        """Start lock-step when the loop is complete, and watch for a command that is missing."""
        if self._phase is Phase.WAITING:
            listeners = self._temperature.get_subscription_count()
            if (listeners >= self._settings.lockstep_subscribers
                    and self._command_subscription.get_publisher_count() > 0):
                self._phase = Phase.RUNNING
                self._measure()
            return
        waited = time.monotonic() - self._wall_published
        if (self._phase is Phase.RUNNING and not self._answered
                and waited > self._settings.lockstep_timeout):
            self._missed += 1
            self._answered = self._waiting_in_vain = True
            self.get_logger().warning(
                f'no command for the measurement at {seconds_text(self._plant.time_ns)} s '
                f'within {self._settings.lockstep_timeout} s: the last one is held',
                throttle_duration_sec=10.0)
            self._continue_lockstep()

    def _step_in_lockstep(self) -> None:
        if self._phase is Phase.RUNNING and self._answered:
            self._measure()

    def _continue_lockstep(self) -> None:
        # with a speed the next tick of the pacing timer does it
        if not self._settings.speed:
            self._step_in_lockstep()

    def _measure(self) -> None:
        """Advance to the next sample and publish it."""
        instant = self._start_ns + self._sample * self._period_ns
        duration_ns = round(self._settings.duration * NANOSECONDS)
        if duration_ns and instant > self._start_ns + duration_ns:
            self._phase = Phase.FINISHED
        elif instant > _LAST_STAMP_NS:
            self._phase = Phase.OUT_OF_STAMPS
            self.get_logger().error(self._phase.value)
        elif self._advance(instant):
            sample, self._sample = self._sample, self._sample + 1
            self._answered = False
            self._wall_published = time.monotonic()
            self._publish(sample)
        self._diagnostics.publish_if_changed()

    def _publish(self, sample: int) -> None:
        """Publish the plant as it stands, the temperature, which is answered, last."""
        plant, settings = self._plant, self._settings
        stamp, frame_id = stamp_message(plant.time_ns), settings.frame_id
        if self._clock_publisher is not None:
            self._clock_publisher.publish(Clock(clock=stamp))
        if self._concentration is not None:
            message = JointState(
                name=['reactant_concentration [mol/L]'], position=[float(plant.x[0])])
            message.header.stamp, message.header.frame_id = stamp, frame_id
            self._concentration.publish(message)
        self._coolant.publish(temperature_message(float(plant.u[0]), stamp, frame_id))
        noise = plants.sensor_noise(settings.noise, settings.seed, sample)
        # the steps of the scale have the variance of a uniform error
        variance = settings.noise ** 2 + settings.sensor_resolution ** 2 / 12.0
        measured = temperature_message(
            float(plant.x[-1]) + noise + settings.sensor_bias, stamp, frame_id, variance)
        measured.temperature = plants.in_steps(measured.temperature, settings.sensor_resolution)
        self._temperature.publish(measured)

    def _advance(self, time_ns: int) -> bool:
        """Bring the process to an instant; a reactor that ran away stops the plant."""
        try:
            self._plant = self._plant.until(time_ns)
        except plants.IntegrationError as error:
            self._phase, self._trip = Phase.TRIPPED, str(error)
            self.get_logger().error(f'{error}; call ~/reset to start again')
            self._diagnostics.publish_if_changed()
            return False
        return True

    def _on_command(self, message: Temperature) -> None:
        stamp_ns = stamp_nanoseconds(message.header.stamp)
        lockstep = self._settings.lockstep
        if lockstep and stamp_ns != self._plant.time_ns:
            # it answers no measurement that is open: late, or from somebody else
            self._foreign += 1
            return
        if math.isfinite(message.temperature):
            self._commands += 1
            self._last_command, self._rejection = time.monotonic(), ''
            # in lock-step it was given at its measurement, otherwise now
            if lockstep or self._advance_to_now():
                command = np.array([to_kelvin(message.temperature)])
                self._plant = self._plant.commanded(command, self._plant.time_ns)
        else:
            self._rejected += 1
            self._rejection = (f'coolant command {message.temperature} degC is not finite and '
                               'was rejected: the last good one is held')
            self.get_logger().warning(self._rejection, throttle_duration_sec=1.0)
            self._diagnostics.publish_if_changed()
        if lockstep and self._phase is Phase.RUNNING and not self._answered:
            self._answered, self._waiting_in_vain = True, False
            self._continue_lockstep()

    def _advance_to_now(self) -> bool:
        if self._phase is not Phase.RUNNING:
            return False
        # never past the next sample, which is measured under the command of its time
        ahead = self._start_ns + self._sample * self._period_ns
        now = self._now_ns() if self._settings.speed else self._plant.time_ns
        return self._advance(min(now, ahead))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Put the reactor back to its initial state; time goes on."""
        if self._phase in (Phase.FINISHED, Phase.OUT_OF_STAMPS):
            response.message = ('the duration is over: start the plant again'
                                if self._phase is Phase.FINISHED else self._phase.value)
            return response
        response.success = True
        self._plant = fresh = self._initial(self._plant.system, self._plant.time_ns)
        if self._phase is Phase.TRIPPED:
            self._phase, self._trip = Phase.RUNNING, ''
            self._resynchronise()
        response.message = (f'reset to {to_celsius(float(fresh.x[-1])):.3f} degC with coolant at '
                            f'{to_celsius(float(fresh.u[0])):.3f} degC')
        self.get_logger().info(response.message)
        self._diagnostics.publish_if_changed()
        return response

    def _resynchronise(self) -> None:
        """Resume after a stop: time has stood still for the plant."""
        if self._settings.lockstep:
            self._answered = True
            self._continue_lockstep()
            return
        passed = self._now_ns() if self._settings.speed else self._plant.time_ns
        self._sample = max(self._sample, -(-(passed - self._start_ns) // self._period_ns))
        self._plant = replace(self._plant, time_ns=max(passed, self._plant.time_ns))

    def _on_parameters(self, parameters: PlantParameters) -> None:
        if not self._settings.lockstep:
            self._advance_to_now()
        self._settings = parameters
        # the changed plant may have no steady state near; the nominal point stays what it was
        self._plant = replace(self._plant, actuator=parameters.actuator(), system=REACTORS[
            parameters.reactor](parameters.constants(),
                                nominal_state=self._plant.system.nominal_state))

    def _status(self) -> Status:
        level, message = Level.OK, self._phase.value
        if self._phase is Phase.TRIPPED:
            level, message = Level.ERROR, f'stopped: {self._trip}; call ~/reset'
        elif self._phase is Phase.OUT_OF_STAMPS:
            level = Level.ERROR
        elif self._rejection:
            level, message = Level.WARN, self._rejection
        elif complaint := self._matching.complaint:
            level, message = Level.WARN, complaint
        elif self._phase is Phase.WAITING:
            level = Level.WARN
        elif self._unanswered():
            level, message = Level.WARN, (
                'running, but no command arrives: the last one is held; is the controller alive?')
        return Status(level, message, {
            'time [s]': seconds_text(self._plant.time_ns),
            'temperature [degC]': to_celsius(float(self._plant.x[-1])),
            'coolant [degC]': to_celsius(float(self._plant.u[0])),
            'coolant command [degC]': to_celsius(float(self._plant.followed[0])),
            'measurements': self._sample,
            'commands': self._commands,
            'rejected commands': self._rejected,
            'missed commands': self._missed,
            'foreign commands': self._foreign,
        })

    def _unanswered(self) -> bool:
        """Tell whether a controller that commanded before has fallen silent."""
        if self._phase is not Phase.RUNNING or self._settings.lockstep:
            return self._waiting_in_vain
        period = self._settings.sample_period / (self._settings.speed or math.inf)
        silence = time.monotonic() - self._last_command
        return bool(self._commands) and silence > max(_SILENCE, 5.0 * period)


def main(args: list[str] | None = None) -> int:
    """Run the plant node."""
    return run('plant', PlantNode, args)


if __name__ == '__main__':
    sys.exit(main())
