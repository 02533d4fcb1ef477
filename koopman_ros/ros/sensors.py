# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the plant publishes at an instant: the time, and what its instruments show."""

from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from koopman_ros.parameters.plant import PlantParameters
from koopman_ros.plants import in_steps, Process, sensor_noise
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_message, temperature_message
from koopman_ros.ros.matching import Matching
from koopman_ros.ros.node import Owned


class Instruments:
    """Publish the measurements of a plant, with the time and its first state if wanted."""

    def __init__(self, node: Node, matching: Matching, clock: bool, concentration: bool) -> None:
        self._owned = owned = Owned(node)
        self._clock = owned.keep(
            node.create_publisher(*topics.of(topics.CLOCK))) if clock else None
        self._concentration = owned.keep(
            node.create_publisher(*topics.of(topics.CONCENTRATION))) if concentration else None
        # the temperature last: who has found it has found the coolant, too
        self._coolant = matching.publish(topics.COOLANT_TEMPERATURE)
        self._temperature = matching.publish(topics.TEMPERATURE)

    def destroy(self) -> None:
        """Take down what `matching` has not made."""
        self._owned.destroy()

    @property
    def subscribers(self) -> int:
        """How many listen to the temperature."""
        return self._temperature.get_subscription_count()

    def publish(self, process: Process, sample: int, settings: PlantParameters) -> None:
        """Publish the plant as it stands, the temperature, which is answered, last."""
        stamp, frame_id = stamp_message(process.time_ns), settings.frame_id
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp))
        if self._concentration is not None:
            message = JointState(
                name=['reactant_concentration [mol/L]'], position=[float(process.x[0])])
            message.header.stamp = stamp
            message.header.frame_id = frame_id
            self._concentration.publish(message)
        self._coolant.publish(temperature_message(float(process.u[0]), stamp, frame_id))
        noise = sensor_noise(settings.noise, settings.seed, sample)
        # the steps of the scale have the variance of a uniform error
        variance = settings.noise ** 2 + settings.sensor_resolution ** 2 / 12.0
        measured = temperature_message(
            float(process.x[-1]) + noise + settings.sensor_bias, stamp, frame_id, variance)
        measured.temperature = in_steps(measured.temperature, settings.sensor_resolution)
        self._temperature.publish(measured)
