# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""One check of a model for its acceptance and for its loading."""

from dataclasses import replace
from pathlib import Path

from hypothesis import given, HealthCheck, settings, strategies
import numpy as np
import pytest

from koopman_ros.control.usable import unusable
from koopman_ros.core.paths import model_path
from koopman_ros.model import Coordinates, LiftedModel, load, ModelFileError, save
from koopman_ros.parameters.model_checks import load_suitable

SHIPPED = load(model_path('reactor_nz4'))
# places of the lower end, the nominal value and the upper end, in K
ENDS = strategies.lists(strategies.integers(-1, 8), min_size=3, max_size=3)
NAMES = strategies.sampled_from(['x', 'u', 'level_1', 'x y', '1x', 'é', ''])


def moved(of: Coordinates, ends: list[int], name: str) -> Coordinates:
    low, center, high = (300.0 + 4.0 * end if end >= 0 else -5.0 for end in ends)
    return replace(of, names=(name,), lower=np.array([low]), center=np.array([center]),
                   upper=np.array([max(high, low + 1.0)]))


def loads(path: Path, model: LiftedModel) -> bool:
    save(model, path)
    try:
        load_suitable(str(path))
    except ModelFileError:
        return False
    return True


@settings(max_examples=60, deadline=None, derandomize=True,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(states=ENDS, inputs=ENDS, names=strategies.tuples(NAMES, NAMES))
def test_a_model_loads_exactly_if_it_is_usable(
        tmp_path: Path, states: list[int], inputs: list[int], names: tuple[str, str]) -> None:
    model = replace(SHIPPED, states=moved(SHIPPED.states, states, names[0]),
                    inputs=moved(SHIPPED.inputs, inputs, names[1]))
    assert loads(tmp_path / 'one.safetensors', model) == (not unusable(model))


@pytest.mark.parametrize(('ends', 'words'), [
    ([2, 0, 6], '26.85 degC, is outside .* record coolant_temperature down to 26.85 degC'),
    ([2, 7, 6], '54.85 degC, is outside .* record coolant_temperature up to 54.85 degC'),
    ([-1, 2, 6], 'begins at -5 K, which is impossible')])
def test_reason_has_the_figure_and_the_remedy(ends: list[int], words: str) -> None:
    model = replace(SHIPPED, inputs=moved(SHIPPED.inputs, ends, 'coolant_temperature'))
    with pytest.raises(AssertionError, match=words):
        assert not unusable(model), unusable(model)


def test_a_nominal_value_may_be_off_an_end_of_the_range_by_rounding() -> None:
    low = np.array([300.1])
    states = replace(SHIPPED.states, lower=low, center=np.array([np.nextafter(low[0], 0.0)]))
    assert not unusable(replace(SHIPPED, states=states))


def test_shipped_models_are_usable() -> None:
    for path in model_path('reactor_nz4').parent.glob('*.safetensors'):
        assert not unusable(load(path)), path
