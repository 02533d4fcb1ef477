# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants of one and two states with samples of them, small enough to learn in a second."""

from dataclasses import replace

import numpy as np

from koopman_ros.core.datasets import DriftSamples, PlantDescription
from koopman_ros.learning import IncrementalTraining
from koopman_ros.plants import two_state_example

# dx/dt = -x - 0.3 x^2 + 2 u, in deviations from 3 m and 0.5 m/s
BENT = PlantDescription('bent', ('level',), ('m',), ('flow',), ('m/s',), 's', np.array([3.0]),
                        np.array([0.5]), np.array([[2.0]]))
# the same without its input
UNFORCED = PlantDescription('unforced', ('level',), ('m',), (), (), 's', np.array([3.0]),
                            np.zeros(0),
                            np.zeros((1, 0)))
SMALL = IncrementalTraining(2, hidden_first=3, max_iterations=40)

_EXAMPLE = two_state_example()
TWO_STATE = PlantDescription(
    _EXAMPLE.name, _EXAMPLE.state_names, _EXAMPLE.state_units, _EXAMPLE.input_names,
    _EXAMPLE.input_units, _EXAMPLE.time_unit, np.zeros(2), np.zeros(1), _EXAMPLE.B)


def bent_samples(episodes=6, length=30, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.5, (episodes * length, 1))
    u = rng.uniform(-1.0, 1.0, (episodes * length, 1))
    return DriftSamples(x + 3.0, -x - 0.3 * x * x + 2.0 * u, u + 0.5,
                        np.repeat(np.arange(episodes), length))


def unforced_samples():
    """Return the same samples without the input and what it does."""
    samples = bent_samples()
    return replace(samples, dxdt=samples.dxdt - 2.0 * (samples.u - 0.5), u=np.zeros((180, 0)))


def two_state_samples(count=600, seed=0):
    rng = np.random.default_rng(seed)
    x = np.stack([rng.uniform(-6.0, 6.0, count), rng.uniform(-6.0, 8.0, count)], 1)
    u = rng.uniform(-5.0, 5.0, (count, 1))
    return DriftSamples(x, _EXAMPLE.derivative(x, u), u, np.arange(count) // (count // 10))


def bits(model):
    network = model.observables
    arrays = (model.A, model.B, network.W, network.b, network.V, model.states.scale,
              np.zeros(0) if model.readout is None else model.readout)
    return b''.join(array.tobytes() for array in arrays)
