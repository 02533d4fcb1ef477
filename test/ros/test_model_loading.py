# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models for the controller: which it takes, and why it refuses the others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from koopman_ros.control import Controller
from koopman_ros.lifting import load, ModelFileError, save
from koopman_ros.resources import model_path
from koopman_ros.ros import model_reload
from koopman_ros.ros.model_reload import load_suitable

SHIPPED = load(model_path('reactor_nz4'))


def named(state: str, coolant: str, path: Path) -> str:
    """Save the shipped model with other names; return where."""
    save(replace(SHIPPED, states=replace(SHIPPED.states, names=(state,)),
                 inputs=replace(SHIPPED.inputs, names=(coolant,))), path)
    return str(path)


@pytest.mark.parametrize('names', [
    ('temperature', 'coolant_temperature'), ('T', 'T_c'), ('reactor', 'jacket'),
    ('temperature', 'coolant')])
def test_names_of_a_model_are_free(tmp_path: Path, names: tuple[str, str]) -> None:
    assert load_suitable(named(*names, tmp_path / 'x.safetensors')).model.states.names[0] == (
        names[0])


@pytest.mark.parametrize('names', [
    ('coolant_temperature', 'temperature'), ('coolant_temperature', 'heater'),
    ('x', 'temperature'), ('x', 'x')])
def test_model_that_takes_the_coolant_for_what_is_controlled_is_refused(
        tmp_path: Path, names: tuple[str, str]) -> None:
    with pytest.raises(ModelFileError, match='needs the temperature as state and that of the coo'):
        load_suitable(named(*names, tmp_path / 'x.safetensors'))


def test_model_whose_step_takes_too_long_is_refused_with_its_time(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """No model within the bounds takes that long, so the limit is moved."""
    monkeypatch.setattr(model_reload, '_LONGEST_STEP', 1e-7)
    with pytest.raises(ModelFileError, match=(
            r'a control step with the model takes [0-9.e-]+ s of a processor, at most 1e-07 s are '
            r'allowed: train one with fewer coordinates \(n_z = 4\)$')):
        load_suitable('reactor_nz4')


def test_model_whose_step_fails_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError('Eigenvalues did not converge')

    monkeypatch.setattr(Controller, 'step', fail)
    with pytest.raises(ModelFileError, match=r'model fails .Eigenvalues did not converge'):
        load_suitable('reactor_nz4')


@pytest.mark.parametrize('name', ['x' * 5000 + '.safetensors', '/tmp/\0.safetensors'])
def test_name_that_is_no_path_is_not_repeated_at_length(name: str) -> None:
    with pytest.raises(ModelFileError, match='is no path of a file, which has at most 4096') as e:
        load_suitable(name)
    assert len(str(e.value)) < 200
