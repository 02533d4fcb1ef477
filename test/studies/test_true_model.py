# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A plant's own equations as a model: against the plant, also where B depends on the state."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.plants.library.reactor import fed_reactor
from studies.true_model import TrueModel

BOX = (np.array([0.8, 305.0]), np.array([1.0, 330.0]))
INPUTS = (np.array([60.0, 281.0]), np.array([150.0, 303.0]))


def test_rates_and_slopes_are_those_of_a_plant_whose_inflow_depends_on_its_state():
    system = fed_reactor()
    model = TrueModel.of(system, *BOX, *INPUTS)
    x, u = np.array([[0.83, 326.0], [0.97, 309.0]]), np.array([[70.0, 285.0], [140.0, 301.0]])
    at, given = model.states.to_deviation(x), model.inputs.to_deviation(u)
    rate = (model.drift(at) + model.forcing(at, given)) * model.states.scale
    np.testing.assert_allclose(rate, system.derivative(x, u), rtol=1e-9, atol=1e-11)
    scale = model.states.scale
    slope = model.drift_jacobian(at) + model.forcing_jacobian(at, given)
    np.testing.assert_allclose(slope * scale[:, None] / scale, system.slope(x, u), rtol=1e-6)
    np.testing.assert_allclose(model.linearised.A, model.A, rtol=1e-12)


def test_a_plant_whose_inflow_is_curved_is_refused():
    system = fed_reactor()
    curved = replace(system, B=lambda x: system.input_matrix(x) * (x[..., 1:, None] / 320.0))
    with pytest.raises(ValueError, match=r'B\(x\) misses an affine function'):
        TrueModel.of(curved, *BOX, *INPUTS)
