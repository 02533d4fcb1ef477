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


"""Models for the controller: read, and tried in the situation that they shall take over."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from datetime import datetime, UTC

from koopman_ros.control import Settings, State
from koopman_ros.lifting import LiftedModel, load, ModelFileError
from koopman_ros.nodes.messages import in_celsius
from koopman_ros.nodes.shipped import model_path
from koopman_ros.nodes.translation import controller_of
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoadedModel:
    """
    A model with what tells its versions apart.

    :param name: of a shipped model, or the path of a file.
    :param model: the lift.
    :param file_time: when the file was written, in UTC.
    """

    name: str
    model: LiftedModel
    file_time: str

    @property
    def about(self) -> str:
        """The model in a few words."""
        states = self.model.states
        return (f'model {self.name}: n_z = {self.model.n_z}, trained for '
                f'{in_celsius(states.lower[0])} to {in_celsius(states.upper[0])}')


@dataclass(frozen=True)
class Situation:
    """
    What a new model has to cope with.

    :param settings: the tuning.
    :param state: of the running controller.
    :param measured: (1,) last temperature in K; NaN before the first.
    """

    settings: Settings
    state: State
    measured: Array


def load_suitable(name: str) -> LoadedModel:
    """
    Load a model and refuse one that is not for one temperature and one coolant temperature.

    :param name: of a shipped model, or the path of a file.
    :raises ModelFileError: naming the file, what is wrong and what to do.
    """
    path = model_path(name)
    model = load(path)
    if (model.states.units, model.inputs.units) != (('K',), ('K',)):
        raise ModelFileError(
            f'{path} has states in {model.states.units} and inputs in {model.inputs.units}, the '
            "controller needs one of each in ('K',): choose a model of the one-state reactor")
    for box in (model.states, model.inputs):
        if not 0.0 < box.lower[0] <= box.center[0] <= box.upper[0]:
            raise ModelFileError(
                f'{path} was trained for a {box.names[0]} of {box.lower[0]:.6g} to '
                f'{box.upper[0]:.6g} K around {box.center[0]:.6g} K, which cannot be: train the '
                'model again')
    with contextlib.suppress(OSError):
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        return LoadedModel(name, model, written.isoformat(timespec='milliseconds'))
    # gone since it was read
    return LoadedModel(name, model, 'unknown')


def refuse_setpoints(model: LiftedModel, situation: Situation) -> None:
    """
    Refuse a model that cannot track what the operator asked for.

    :raises ModelFileError: naming the set-point and the trained range.
    """
    controller = controller_of(model, situation.settings)
    setpoint = situation.state.setpoint
    asked = [value for _, value in setpoint.scheduled]
    asked += [value for value in (setpoint.requested, setpoint.active) if value is not None]
    for value in asked:
        reason = controller.request_setpoint(situation.state, value)[1]
        if reason:
            raise ModelFileError(reason)


def refuse_without_law(model: LiftedModel, situation: Situation) -> None:
    """
    Refuse a model with which the control step cannot act where the plant is or shall go.

    :raises ModelFileError: naming the temperature and the reason.
    """
    controller = controller_of(model, situation.settings)
    asked = (situation.state.setpoint.active, situation.state.setpoint.requested)
    for setpoint in [value for value in asked if value is not None] or [model.states.center]:
        for place in (setpoint, situation.measured):
            # neither before the first measurement, nor where the learned law would not act
            if not model.distance(place) <= situation.settings.ladder.validity_margin:
                continue
            if problem := controller.try_law(place, setpoint):
                raise ModelFileError(
                    f'tried at {in_celsius(float(place[0]))} with the set-point '
                    f'{in_celsius(float(setpoint[0]))} the model fails ({problem}): train it '
                    'again, or change the weights')
