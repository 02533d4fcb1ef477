# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models for a controller: loaded, and rejected where they do not suit it."""

import contextlib
from dataclasses import dataclass
from datetime import datetime, UTC

import numpy as np

from koopman_ros.control import Controller, State
from koopman_ros.control.usable import unusable
from koopman_ros.core.arrays import Array
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import quantity_text, shown
from koopman_ros.evaluation import compare, PredictionWindows
from koopman_ros.model import LiftedModel, load_with_digest, ModelFileError
from koopman_ros.parameters.controller import built, ControllerParameters, table_of
from koopman_ros.parameters.signal_topics import Signals, signals_of, words_of

_LONGEST_PATH = 4096  # bytes, as Linux has it


@dataclass(frozen=True)
class LoadedModel:
    """A model with the identity of its file."""

    name: str  #: of a shipped model, or the path of a file
    model: LiftedModel
    file_time: str  #: when the file was written, in UTC
    digest: str  #: SHA-256 of the file
    comparison: str = ''  #: with the previous model, on the measurements then; empty at the start

    @property
    def identity(self) -> dict[str, str]:
        """The identity of the model in records."""
        return {'name': self.name, 'digest': self.digest}

    @property
    def about(self) -> str:
        """The model in a few words."""
        return (f'model {self.name}: {self.model.kind}, trained for {ranges(self.model)}; '
                f'acceptance: {self.model.provenance.acceptance}')


@dataclass(frozen=True)
class ModelCheckContext:
    """The situation in which a new model must work."""

    parameters: ControllerParameters
    state: State
    measured: Array  #: (n_y,) last measurement; NaN before the first
    recent: PredictionWindows | None  #: recent measurements; None while they are too few

    def controller(self, model: LiftedModel) -> Controller:
        """Return the controller of a model; ModelFileError where it cannot be."""
        try:
            return built(self.parameters, model)
        except ValueError as error:
            raise ModelFileError(f'the model does not fit the parameters: {error}') from error


def ranges(model: LiftedModel) -> str:
    """Write the training range of each state for the operator."""
    states = model.states
    return ', '.join(
        f'{name} {shown(low, unit):.6g} to {quantity_text(high, unit)}'
        for name, unit, low, high in zip(states.names, states.units, states.lower.tolist(),
                                         states.upper.tolist(), strict=True))


def load_suitable(name: str, signals: Signals | None = None, *, force: bool = False
                  ) -> LoadedModel:
    """
    Load a model, of these signals where they are given; ModelFileError with the reason.

    :param force: whether to load a model that its training rejected.
    """
    if not name:
        raise ModelFileError('model is empty: name a bundled model or a .safetensors file')
    if len(name.encode()) > _LONGEST_PATH or '\0' in name:
        raise ModelFileError(f'model = {name[:50]!r}... is not a valid path (at most '
                             f'{_LONGEST_PATH} bytes): check it')
    path = model_path(name)
    model, digest = load_with_digest(path)
    if reason := unusable(model, _with_defaults):
        raise ModelFileError(f'{path}: {reason}')
    if model.provenance.accepted is False and not force:
        raise ModelFileError(
            f'{path} was {model.provenance.acceptance}: train it again, or set '
            'load_rejected_model to true to use it anyway')
    own = signals_of(model)
    if signals is not None and not (own.inputs == signals.inputs
                                    and own.disturbances == signals.disturbances
                                    and signals.states.items() <= own.every.items()):
        raise ModelFileError(
            f'{path} has {own}, but this controller was started for {signals}: choose a model of '
            'the same signals, or restart the controller')
    written = 'unknown'
    # the file may be gone since it was read
    with contextlib.suppress(OSError):
        written = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(
            timespec='milliseconds')
    return LoadedModel(name, model, written, digest)


def _with_defaults(model: LiftedModel) -> Controller:
    return built(table_of(model, {'system': ''}).snapshot({}), model)


def reject_setpoints(model: LiftedModel, situation: ModelCheckContext) -> None:
    """Raise ModelFileError for a model that cannot track the requested set-point."""
    controller = situation.controller(model)
    if (rejection := controller.untrained(situation.state.setpoint)) is not None:
        raise ModelFileError(words_of(signals_of(model))(rejection))


def reject_without_law(model: LiftedModel, situation: ModelCheckContext) -> None:
    """Raise ModelFileError for a model without a law where the plant is or shall go."""
    controller, asked = situation.controller(model), situation.state.setpoint
    margin = controller.usable.law.margin
    for setpoint in [value for value in (asked.active, asked.requested)
                     if value is not None and np.isfinite(value).all()] or [
                         controller.controlled.center]:
        for place in (controller.steady_state(setpoint), controller.position(situation.measured)):
            # neither before the first measurement, nor where the learned law would not act
            if not model.distance(place) <= margin:
                continue
            if (problem := controller.try_law(place, setpoint)) is not None:
                tried = (f'at {model.states.text(place)} with the set-point '
                         f'{controller.controlled.text(setpoint)} the control law of the model '
                         f'fails ({words_of(signals_of(model))(problem)})')
                # another model fails for the same reason
                raise ModelFileError(tried if controller.usable.unusable is not None else
                                     f'{tried}: train it again, or change the weights')


def reject_worse(present: LiftedModel, model: LiftedModel, situation: ModelCheckContext) -> str:
    """
    Raise ModelFileError for a model that predicts recent measurements much worse.

    :return: the comparison with the current one, in words.
    """
    found = None if situation.recent is None else compare(
        situation.controller(present), situation.controller(model), situation.recent)
    if found is None:
        return 'not compared with the previous model: too few measurements so far'
    i = int(np.argmax(found.ratio))
    name, unit = list(situation.parameters.states)[i], list(signals_of(
        model, measured=situation.parameters.states).states.values())[i]
    words = (f'predicts {name} of the last {found.seconds:.3g} s with an error of '
             f'{found.candidate[i]:.2g} {unit}, the {{}} with {found.present[i]:.2g} {unit}')
    # written so that NaN is rejected, too
    most = situation.parameters.model_check_factor
    if most and not found.ratio[i] <= most:
        raise ModelFileError(
            f'the model {words.format("current one")}, at most {most * found.allowance[i]:.2g} '
            f'{unit} are allowed: train it again with more data, or set model_check_factor = 0 to '
            'load it anyway')
    return words.format('previous model') + (
        '' if found.tells else '; the signals moved too little for a stricter check')


def rests_outside(controller: Controller) -> str:
    """Return the warning that the safe input keeps the plant where no law may act, or ''."""
    model, rest = controller.model, controller.rest
    # a model without training data is a linearisation, which does not know where that is
    if rest.holding is None or not model.provenance.data_digest:
        return ''
    safe, holding = controller.safe_input, rest.holding
    where = 'does not settle' if np.isnan(rest.x).any() else (
        f'would settle at about {model.states.text(rest.x)} by extrapolation')
    inputs = model.inputs.names, model.inputs.units
    # the input that holds a plant of several inputs there may be far out of their range
    better = '' if controller.tuning.limits.within(holding).tolist() != holding.tolist() else (
        ', or set ' + ', '.join(
            f'{name}.safe_value = {quantity_text(held, unit)} or '
            f'{"more" if held > now else "less"}' for name, unit, now, held in zip(
                *inputs, safe.tolist(), holding.tolist(), strict=True))
        + ' if that is still safe')
    under = ', '.join(f'{name}.safe_value = {quantity_text(now, unit)}' for name, unit, now in zip(
        *inputs, safe.tolist(), strict=True))
    return (f'under {under} the plant leaves the trained range, {ranges(model)}, and {where}: no '
            'law can act there, and recovery is slow; record data there and train again'
            f'{better}')
