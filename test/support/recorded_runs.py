# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Runs of a reactor as a trainer would have recorded them, and a controller with its records."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
import importlib
from pathlib import Path
from typing import Any
import warnings

import numpy as np

from koopman_ros import plants
from koopman_ros.control import Controller, State
from koopman_ros.control.events import apply, Event, EventOutcome, Measurement, Silence
from koopman_ros.core.datasets import Episode
from koopman_ros.core.message_fields import place
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS as SECOND
from koopman_ros.core.units import to_celsius
from koopman_ros.event_log import records
from koopman_ros.model import LiftedModel, load_with_digest
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.records import BagWriter, message_definition, RecordedInput, RecordedState
from support.disturbance import disturbed

NOISE = 0.1  # K
# of the reactor, as a task names them
STATES = (RecordedState('temperature', 'K', place('/temperature', '', 'K')),)
INPUTS = (RecordedInput('coolant_temperature', 'K', place('/coolant_setpoint', '', 'K'),
                        place('/coolant_temperature', '', 'K')),)


@dataclass(frozen=True)
class Run:
    """Noisy temperatures [K] once a second, and the coolant [K] held from each of them on."""

    kelvin: np.ndarray
    coolant: np.ndarray

    def episode(self) -> Episode:
        minutes = np.arange(len(self.kelvin)) / 60.0
        return Episode(minutes, self.kelvin[:, None], minutes, self.coolant[:, None])


def reactor(heat_transfer: float = 1.0) -> plants.ControlAffineSystem:
    """Return the reactor with a jacket that has lost some of its heat transfer."""
    clean = plants.ReactorParameters()
    return plants.one_state_reactor(replace(
        clean, heat_transfer_coefficient=heat_transfer * clean.heat_transfer_coefficient),
        nominal_state=[314.475])


def driven(system: plants.ControlAffineSystem, minutes: float, *, seed: int = 0,
           noise: float = NOISE, coolant: tuple[float, float] = (276.0, 300.0)) -> Run:
    """Drive a reactor by random steps that hold it between 305 and 327 K."""
    others = [0.0] * (system.n_x - 1), [1.0] * (system.n_x - 1)
    design = plants.RandomStepDesign(
        *coolant, [*others[0], 305.0], [*others[1], 327.0], (0.5, 2.0), 1.0 / 60.0, rtol=1e-9)
    path = plants.random_steps(system, design, minutes, seed)
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
    return write_messages(path, [
        (second * SECOND, *row) for second, row in enumerate(
            zip(run.kelvin.tolist(), run.coolant.tolist(), strict=True), 1)])


def write_messages(path: Path, rows: Iterable[tuple[int, float, float]],
                   texts: Iterable[str] = (), prefix: str = '') -> Path:
    """Write measurements and commands, stamped in ns and in K, and a controller's records."""
    with warnings.catch_warnings():
        # The type support imports its generator, whose parser imports a deprecated module.
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize = importlib.import_module('rclpy.serialization').serialize_message
        message = importlib.import_module('sensor_msgs.msg').Temperature()
        text = importlib.import_module('std_msgs.msg').String()
        with BagWriter(path) as writer:
            for topic in ('/temperature', '/coolant_setpoint'):
                writer.add_topic(topic, message_definition('sensor_msgs/msg/Temperature'))
            for stamp_ns, temperature, coolant in rows:
                message.header.stamp.sec = stamp_ns // SECOND
                for offset, (topic, kelvin) in enumerate((
                        ('/temperature', temperature), ('/coolant_setpoint', coolant))):
                    message.temperature = to_celsius(kelvin)
                    writer.write(topic, serialize(message), stamp_ns + offset)
            for number, record in enumerate(texts):
                text.data = record
                topic = f'{prefix}/event_log'
                writer.add_topic(topic, message_definition('std_msgs/msg/String'))
                writer.write(topic, serialize(text), number)
    return path


STEADY, COOLANT = 324.9, 300.0  # K
MODELS = {name: load_with_digest(model_path(name))
          for name in ('reactor_nz3', 'reactor_nz4', 'reactor_linear')}
TABLE = table_of(MODELS['reactor_nz4'][0])


class Recorded:
    """A controller with a model and a tuning that writes down what happens to it."""

    def __init__(self, name: str = 'reactor_nz4', run: str = 'a', **parameters: float) -> None:
        self.run, self.now = run, 0
        self.parameters = {**TABLE.values(TABLE.snapshot({})), 'model': name, **parameters}
        self.controller = self.built(MODELS[name][0])
        self.state = State()
        self.texts: list[str] = []
        self.answers: list[tuple[int, float, float]] = []  # stamp in ns, measured and command in K
        self.commands: list[np.ndarray] = []
        self.snapshot(records.START)

    def built(self, model: LiftedModel) -> Controller:
        """Return the controller that the parameters stand for, with any of the models."""
        return built(TABLE.snapshot(self.parameters), model)

    def write(self, event: str, fields: Mapping[str, object]) -> None:
        self.texts.append(records.EventRecord(self.run, len(self.texts), event, fields).text())

    def snapshot(self, event: str = records.SNAPSHOT) -> None:
        name = self.parameters['model']
        self.write(event, records.snapshot(
            self.state, self.parameters, {'name': name, 'digest': MODELS[name][1]}))

    def do(self, event: Event) -> EventOutcome:
        outcome = apply(self.controller, self.state, event)
        self.state = outcome.state
        if outcome.command is not None:
            self.commands.append(outcome.command)
        if not isinstance(event, Silence) or outcome.command is not None:
            self.write(*records.fields_of(event, outcome))
        return outcome

    def measure(self, kelvin: float, after: float = 1.0, applied: float | None = None,
                seconds: float | None = None) -> None:
        self.now += round(after * SECOND)
        self.do(Measurement(self.now, np.array([kelvin]),
                            None if applied is None else np.array([applied]), seconds))
        self.answers.append((self.now, kelvin, float(self.commands[-1][0])))

    def exchange(self, **parameters: object) -> None:
        """Set parameters; the same model once more is read again."""
        self.parameters |= parameters
        model = self.controller.model
        fields: dict[str, object] = {'parameters': parameters}
        if 'model' in parameters:
            name = str(parameters['model'])
            model = load_with_digest(model_path(name))[0]
            fields['model'] = {'name': name, 'digest': MODELS[name][1]}
        predecessor = self.controller
        self.controller = self.built(model)
        self.state = self.controller.switch_to(predecessor, self.state)
        event = records.PARAMETERS if len(parameters) > ('model' in parameters) else records.MODEL
        self.write(event, fields)

    def save(self, path: Path, change: Callable[[list[Any]], Iterable[Any]] = list,
             prefix: str = '') -> Path:
        """Write a bag of measurements, commands and records, which may be changed."""
        return write_messages(path, self.answers, [
            record.text() for record in change(list(map(records.parse, self.texts)))], prefix)
