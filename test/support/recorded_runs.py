# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Runs of a reactor as a trainer would have recorded them."""

from dataclasses import dataclass, replace
import importlib
from pathlib import Path
import warnings

import numpy as np

from koopman_ros.bags import BagWriter, message_definition
from koopman_ros.plant_data import Episode
from koopman_ros.plants import (
    ControlAffineSystem,
    one_state_reactor,
    random_steps,
    RandomStepDesign,
    ReactorParameters,
)
from koopman_ros.units import NANOSECONDS as SECOND
from support.disturbance import disturbed

NOISE = 0.1  # K
_TYPE = 'sensor_msgs/msg/Temperature'


@dataclass(frozen=True)
class Run:
    """Noisy temperatures [K] once a second, and the coolant [K] held from each of them on."""

    kelvin: np.ndarray
    coolant: np.ndarray

    def episode(self) -> Episode:
        """Return the run with times in minutes."""
        minutes = np.arange(len(self.kelvin)) / 60.0
        return Episode(minutes, self.kelvin[:, None], minutes, self.coolant[:, None])


def reactor(heat_transfer: float = 1.0) -> ControlAffineSystem:
    """Return the reactor with a jacket that has lost some of its heat transfer."""
    clean = ReactorParameters()
    return one_state_reactor(replace(
        clean, heat_transfer_coefficient=heat_transfer * clean.heat_transfer_coefficient),
        nominal_state=[314.475])


def driven(system: ControlAffineSystem, minutes: float, *, seed: int = 0, noise: float = NOISE,
           coolant: tuple[float, float] = (276.0, 300.0)) -> Run:
    """Drive a reactor by random steps that hold it between 305 and 327 K."""
    others = [0.0] * (system.n_x - 1), [1.0] * (system.n_x - 1)
    design = RandomStepDesign(
        *coolant, [*others[0], 305.0], [*others[1], 327.0], (0.5, 2.0), 1.0 / 60.0, rtol=1e-9)
    path = random_steps(system, design, minutes, seed)
    true = path.x[:, -1]
    noisy = true + noise * np.random.default_rng(seed).standard_normal(len(true))
    return Run(disturbed(noisy), np.append(path.u[:, 0], path.u[-1, 0]))


def linear_run(count: int) -> Run:
    """Return a run of dT/dt = -(T - 315) / 2 + (Tc - 288), in minutes, exact for each second."""
    rng = np.random.default_rng(0)
    coolant = 288.0 + np.repeat(rng.uniform(-3.0, 3.0, -(-count // 30)), 30)[:count]
    decay = np.exp(-0.5 / 60.0)
    kelvin = np.empty(count)
    kelvin[0] = 315.0
    for k, u in enumerate(coolant[:-1]):
        rest = 315.0 + 2.0 * (u - 288.0)
        kelvin[k + 1] = rest + decay * (kelvin[k] - rest)
    return Run(kelvin + 0.02 * rng.standard_normal(count), coolant)


def write_bag(path: Path, run: Run) -> Path:
    """Write a run of the lock-step loop, stamped from 1 s on."""
    with warnings.catch_warnings():
        # The type support imports its generator, whose parser imports a deprecated module.
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize = importlib.import_module('rclpy.serialization').serialize_message
        message = importlib.import_module('sensor_msgs.msg').Temperature()
        with BagWriter(path) as writer:
            for topic in ('/temperature', '/coolant_setpoint'):
                writer.add_topic(topic, message_definition(_TYPE))
            for k, (temperature, coolant) in enumerate(
                    zip(run.kelvin, run.coolant, strict=True), 1):
                message.header.stamp.sec = k
                for offset, (topic, kelvin) in enumerate((
                        ('/temperature', temperature), ('/coolant_setpoint', coolant))):
                    message.temperature = float(kelvin) - 273.15
                    writer.write(topic, serialize(message), k * SECOND + offset)
    return path
