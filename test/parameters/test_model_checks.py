# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models for a running controller: those that do not suit it are rejected with the reason."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import re
import sys

import numpy as np
import pytest

from koopman_ros.control import State, usable
from koopman_ros.core.paths import model_path
from koopman_ros.core.units import NANOSECONDS, to_kelvin
from koopman_ros.model import LiftedModel, load, ModelFileError, save
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.parameters.model_checks import (
    load_suitable,
    ModelCheckContext,
    reject_setpoints,
    reject_without_law,
    rests_outside,
)
from koopman_ros.parameters.signal_topics import bundled_plants, plant_defaults, signals_of

SHIPPED = load(model_path('reactor_nz4'))
TABLE = table_of(SHIPPED)
MEASURED = np.array([to_kelvin(51.8)])  # K
# tracks the first measurement
STATE = built(TABLE.snapshot({}), SHIPPED).step(State(), MEASURED, NANOSECONDS)[0]


def with_states(**changes: object) -> LiftedModel:
    return replace(SHIPPED, states=replace(SHIPPED.states, **changes))


def renamed(state: str, coolant: str) -> LiftedModel:
    return replace(with_states(names=(state,)), inputs=replace(SHIPPED.inputs, names=(coolant,)))


@pytest.mark.parametrize(('model', 'words'), [
    (with_states(units=('degC',)), 'has states temperature [degC] and inputs coolant_temperature '
     '[K], but this controller was started for states temperature [K] and inputs'),
    *((renamed(*names), 'choose a model of the same signals') for names in (
        ('T', 'coolant_temperature'), ('temperature', 'coolant'),
        # which would cool where it is cold
        ('coolant_temperature', 'temperature'))),
    (with_states(center=np.array([400.0])),
     'degC, is outside its trained range, 31.85 degC to 53.85 degC'),
    (with_states(lower=np.array([-5.0])), 'which is impossible: train the model again'),
    (with_states(upper=np.array([324.8])),
     'set-point 51.80 degC is outside the trained range 31.85 degC to 51.65 degC'),
    # an input without effect
    (replace(SHIPPED, A=-SHIPPED.A, B=np.zeros((1, 1))),
     'at temperature 51.8 degC with the set-point temperature 51.8 degC the control law of '
     'the model fails (no feedback gain: the Hamiltonian has no stable subspace of full size'),
    # a gain beyond its bound
    (replace(SHIPPED, A=1e6 * np.abs(SHIPPED.A)), 'the model fails'),
    (replace(SHIPPED, provenance=replace(
        SHIPPED.provenance, accepted=False, reasons=('too large an error',))),
     'was rejected (too large an error): train it again, or set load_rejected_model'),
])
def test_unsuitable_model_is_rejected_with_the_reason(
        tmp_path: Path, model: LiftedModel, words: str) -> None:
    file = tmp_path / 'bad.safetensors'
    save(model, file)
    situation = ModelCheckContext(TABLE.snapshot({}), STATE, MEASURED, None)

    def try_model() -> None:
        loaded = load_suitable(str(file), signals_of(SHIPPED)).model
        reject_setpoints(loaded, situation)
        reject_without_law(loaded, situation)

    with pytest.raises(ModelFileError, match=re.escape(words)):
        try_model()


def test_a_model_is_tried_with_the_law_that_can_act(monkeypatch: pytest.MonkeyPatch) -> None:
    """If a package of the best law is missing, no other model helps."""
    monkeypatch.setitem(sys.modules, 'koopman_ros.control.mpc.planner', None)

    def situation(*levels: str) -> ModelCheckContext:
        return ModelCheckContext(TABLE.snapshot({'fallback_order': levels}), State(),
                                 SHIPPED.states.center, None)

    reject_without_law(SHIPPED, situation('mpc', 'sdre', 'linear'))
    bad = replace(SHIPPED, A=1e300 * SHIPPED.A)
    with pytest.raises(ModelFileError, match='train it again'):
        reject_without_law(bad, situation('mpc', 'sdre', 'linear'))
    with pytest.raises(ModelFileError, match=r'pip install daqp\)$'):
        reject_without_law(SHIPPED, situation('mpc'))


def slow(patch: pytest.MonkeyPatch) -> None:
    # no model within the bounds takes that long, so the limit is moved
    patch.setattr(usable, '_LONGEST_STEP', 1e-7)


def failing(patch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError('Eigenvalues did not converge')

    patch.setattr(LiftedModel, 'distance', fail)


@pytest.mark.parametrize(('name', 'prepare', 'words'), [
    ('reactor_nz4', slow, 's of processor time'),
    ('reactor_nz4', failing, 'model fails .*Eigenvalues did not converge'),
    ('x' * 5000 + '.safetensors', lambda _: None, 'most 4096'),
    ('/tmp/\0.safetensors', lambda _: None, 'most 4096'),
])
def test_model_that_cannot_be_used_is_rejected_in_a_short_sentence(
        monkeypatch: pytest.MonkeyPatch, name: str,
        prepare: Callable[[pytest.MonkeyPatch], None], words: str) -> None:
    prepare(monkeypatch)
    with pytest.raises(ModelFileError, match=words) as rejected:
        load_suitable(name)
    assert len(str(rejected.value)) < 250
    # nor does training accept it
    assert name != 'reactor_nz4' or re.search(words, usable.unusable(SHIPPED))


def test_a_controller_is_built_for_states_of_nanoamperes() -> None:
    states = SHIPPED.states
    tiny = with_states(units=('A',), **{
        name: 1e-9 * getattr(states, name) for name in ('center', 'scale', 'lower', 'upper')})
    table = table_of(tiny, {'system': ''})
    settings = table.snapshot({})
    assert table.check(settings) == ''
    assert built(settings, tiny).tuning.state_weight == pytest.approx(1.0 / tiny.states.scale ** 2)


@pytest.mark.parametrize('system', bundled_plants())
def test_the_safe_inputs_of_shipped_plants_keep_them_within_reach(system: str) -> None:
    model = load(model_path(plant_defaults(system, 'controller')['model']))
    table = table_of(model, {'system': system})
    assert rests_outside(built(table.snapshot({}), model)) == ''
