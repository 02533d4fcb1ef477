# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models for the controller: read, and tried in the situation that they shall take over."""

import contextlib
from dataclasses import dataclass
from datetime import datetime, UTC
from pathlib import Path
import time

import numpy as np
from numpy.typing import NDArray

from koopman_ros.control import Controller, Settings, State
from koopman_ros.lifting import LiftedModel, load_with_digest, ModelFileError
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.resources import model_path
from koopman_ros.ros.diagnostics import words_of
from koopman_ros.units import in_celsius, NANOSECONDS

Array = NDArray[np.float64]

# Names of the other one: with these a model takes the coolant for what is controlled.
_MISPLACED = ('coolant_temperature', 'temperature')
_LONGEST_PATH = 4096  # bytes, as Linux has it
# What a control step may take of a processor, in s: the largest model that is read takes some
# milliseconds, and measurements come once a second.
_LONGEST_STEP = 0.1
_TRIALS = 3


@dataclass(frozen=True)
class LoadedModel:
    """A model with what tells its versions apart."""

    name: str  #: of a shipped model, or the path of a file
    model: LiftedModel
    file_time: str  #: when the file was written, in UTC
    digest: str  #: SHA-256 of the file

    @property
    def identity(self) -> dict[str, str]:
        """What records name it by."""
        return {'name': self.name, 'digest': self.digest}

    @property
    def about(self) -> str:
        """The model in a few words."""
        states = self.model.states
        return (f'model {self.name}: n_z = {self.model.n_z}, trained for '
                f'{in_celsius(states.lower[0])} to {in_celsius(states.upper[0])}')


@dataclass(frozen=True)
class Situation:
    """What a new model has to cope with."""

    settings: Settings
    state: State
    measured: Array  #: (1,) last temperature in K; NaN before the first


def load_suitable(name: str) -> LoadedModel:
    """
    Load a model by name or path, if it is for one temperature and one coolant temperature.

    :raises ModelFileError: naming the file, what is wrong and what to do; also for a model that
        a control step fails with, or takes too long for.
    """
    if len(name.encode()) > _LONGEST_PATH or '\0' in name:
        raise ModelFileError(f'model = {name[:50]!r}... is no path of a file, which has at most '
                             f'{_LONGEST_PATH} bytes: check it')
    path = model_path(name)
    model, digest = load_with_digest(path)
    if (model.states.units, model.inputs.units) != (('K',), ('K',)):
        raise ModelFileError(
            f'{path} has states in {model.states.units} and inputs in {model.inputs.units}, the '
            "controller needs one of each in ('K',): choose a model of the one-state reactor")
    names = (model.states.names[0], model.inputs.names[0])
    if names[0] == names[1] or any(map(str.__eq__, names, _MISPLACED)):
        raise ModelFileError(
            f'{path} has {names[0]!r} as state and {names[1]!r} as input, the controller needs '
            'the temperature as state and that of the coolant as input: choose a model of the '
            'one-state reactor')
    for box in (model.states, model.inputs):
        if not 0.0 < box.lower[0] <= box.center[0] <= box.upper[0]:
            raise ModelFileError(
                f'{path} was trained for a {box.names[0]} of {box.lower[0]:.6g} to '
                f'{box.upper[0]:.6g} K around {box.center[0]:.6g} K, which cannot be: train the '
                'model again')
    _refuse_slow(path, model)
    with contextlib.suppress(OSError):
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        return LoadedModel(name, model, written.isoformat(timespec='milliseconds'), digest)
    # gone since it was read
    return LoadedModel(name, model, 'unknown', digest)


def _refuse_slow(path: Path, model: LiftedModel) -> None:
    controller, state = Controller(model, ControllerParameters().settings()), State()
    needed = []
    for k in range(1, _TRIALS + 1):
        # of this thread alone, for a busy machine says nothing of a model
        begun = time.thread_time()
        try:
            state = controller.step(state, model.states.center, k * NANOSECONDS)[0]
            # which diagnostics tell
            controller.equivalent_bias(state)
        except (ArithmeticError, ValueError) as error:
            raise ModelFileError(f'{path}: a control step with the model fails ({error}): train '
                                 'it again') from error
        needed.append(time.thread_time() - begun)
    if min(needed) > _LONGEST_STEP:
        raise ModelFileError(
            f'{path}: a control step with the model takes {min(needed):.3g} s of a processor, at '
            f'most {_LONGEST_STEP:g} s are allowed: train one with fewer coordinates (n_z = '
            f'{model.n_z})')


def refuse_setpoints(model: LiftedModel, situation: Situation) -> None:
    """Raise ModelFileError for a model that cannot track what the operator asked for."""
    controller = Controller(model, situation.settings)
    setpoint = situation.state.setpoint
    asked = [value for _, value in setpoint.scheduled]
    asked += [value for value in (setpoint.requested, setpoint.active) if value is not None]
    for value in asked:
        refusal = controller.request_setpoint(situation.state, value)[1]
        if refusal is not None:
            raise ModelFileError(words_of(model)(refusal))


def refuse_without_law(model: LiftedModel, situation: Situation) -> None:
    """Raise ModelFileError for a model without a law where the plant is or shall go."""
    controller = Controller(model, situation.settings)
    asked = (situation.state.setpoint.active, situation.state.setpoint.requested)
    for setpoint in [value for value in asked if value is not None] or [model.states.center]:
        for place in (setpoint, situation.measured):
            # neither before the first measurement, nor where the learned law would not act
            if not model.distance(place) <= situation.settings.supervisor.levels[0].margin:
                continue
            if (problem := controller.try_law(place, setpoint)) is not None:
                raise ModelFileError(
                    f'tried at {in_celsius(float(place[0]))} with the set-point '
                    f'{in_celsius(float(setpoint[0]))} the model fails '
                    f'({words_of(model)(problem)}): train it again, or change the weights')


def rests_outside(controller: Controller) -> str:
    """
    Say that the safe coolant keeps the reactor where no law may act, or return an empty string.

    A model without training data is a linearisation, which does not know where that is.
    """
    model, rest = controller.model, controller.rest
    if rest.holding is None or not model.provenance.data_digest:
        return ''
    safe, holding = float(controller.safe_input[0]), float(rest.holding[0])
    states, place = model.states, float(rest.x[0])
    where = 'does not come to rest' if np.isnan(place) else (
        f'rests at about {in_celsius(place)} if one extrapolates')
    return (f'under safe_coolant = {in_celsius(safe)} the reactor leaves the trained range, '
            f'{in_celsius(states.lower[0])} to {in_celsius(states.upper[0])}, and {where}: no law '
            'can act there, and the way back is slow; record data from there and train again, or '
            f'set safe_coolant to {in_celsius(holding)} or {"more" if holding > safe else "less"} '
            'if that is still safe')
