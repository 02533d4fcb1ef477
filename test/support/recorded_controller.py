# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A controller in the test's own process that writes down what happens to it."""

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from koopman_ros.control import Controller, State
from koopman_ros.control.events import apply, Event, Measurement, Outcome, Silence
from koopman_ros.lifting import load_with_digest
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.replay.records import (
    fields_of,
    MODEL,
    PARAMETERS,
    Record,
    SNAPSHOT,
    snapshot,
    START,
)
from koopman_ros.resources import model_path
from koopman_ros.units import NANOSECONDS as SECOND

STEADY, COOLANT = 324.9, 300.0  # K
MODELS = {name: load_with_digest(model_path(name))
          for name in ('reactor_nz3', 'reactor_nz4', 'reactor_linear')}


class Recorded:
    """
    A controller that writes down what happens to it.

    :param name: of its model.
    :param parameters: of its tuning.
    """

    def __init__(self, name: str = 'reactor_nz4', run: str = 'a', **parameters: float) -> None:
        self.run, self.now = run, 0
        self.parameters = ControllerParameters(model=name, **parameters)
        self.controller = Controller(MODELS[name][0], self.parameters.settings())
        self.state = State()
        self.texts: list[str] = []
        self.commands: list[np.ndarray] = []
        self.snapshot(START)

    def write(self, event: str, fields: Mapping[str, object]) -> None:
        self.texts.append(Record(self.run, len(self.texts), event, fields).text())

    def snapshot(self, event: str = SNAPSHOT) -> None:
        name = self.parameters.model
        self.write(event, snapshot(self.state, asdict(self.parameters),
                                   {'name': name, 'digest': MODELS[name][1]}))

    def do(self, event: Event) -> Outcome:
        outcome = apply(self.controller, self.state, event)
        self.state = outcome.state
        if outcome.command is not None:
            self.commands.append(outcome.command)
        if not isinstance(event, Silence) or outcome.command is not None:
            self.write(*fields_of(event, outcome))
        return outcome

    def measure(self, kelvin: float, after: float = 1.0, applied: float | None = None) -> None:
        self.now += round(after * SECOND)
        self.do(Measurement(self.now, np.array([kelvin]),
                            None if applied is None else np.array([applied])))

    def exchange(self, **parameters: object) -> None:
        """Set parameters; the same model once more is read again."""
        self.parameters = replace(self.parameters, **parameters)
        model = self.controller.model
        fields: dict[str, object] = {'parameters': parameters}
        if 'model' in parameters:
            name = self.parameters.model
            model = load_with_digest(model_path(name))[0]
            fields['model'] = {'name': name, 'digest': MODELS[name][1]}
        predecessor = self.controller
        self.controller = Controller(model, self.parameters.settings())
        self.state = self.controller.hand_over(predecessor, self.state)
        self.write(PARAMETERS if len(parameters) > ('model' in parameters) else MODEL, fields)
