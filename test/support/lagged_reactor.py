# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The reactor behind an actuator with a lag, and a model that has the applied coolant."""

import numpy as np

from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.learning.lift.edmd import Edmd
from koopman_ros.model import LiftedModel
from koopman_ros.plants import equilibrium_input
from support.closed_loops import REACTOR, START


def lagged_model(seconds: float) -> LiftedModel:
    """Return a polynomial model of temperature and applied coolant."""
    u0, rate = equilibrium_input(REACTOR, np.array([START])), 60.0 / seconds
    x = np.stack(np.meshgrid(np.linspace(START - 18.0, START + 4.0, 23), np.linspace(
        u0[0] - 15.0, u0[0] + 15.0, 21)), axis=-1).reshape(-1, 2)
    u = x[::-1, 1:]
    dxdt = np.hstack([REACTOR.derivative(x[:, :1], x[:, 1:]), rate * (u - x[:, 1:])])
    plant = PlantDescription(
        'one-state reactor', ('temperature', 'applied_coolant_temperature'), ('K', 'K'),
        ('coolant_temperature',), ('K',), 'min', np.array([START, u0[0]]), u0,
        np.array([[0.0], [rate]]))
    return Edmd(3).learn(plant, DriftSamples(x, dxdt, u, np.zeros(len(x), dtype=int)))
