# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trajectories and the derivative samples taken from them."""

import numpy as np
import pytest

from koopman_ros.plants import (
    one_state_reactor,
    sample_derivatives,
    scalar_example,
    simulate,
    simulate_many,
    Trajectory,
    two_state_reactor,
)


def test_derivative_samples_are_exact():
    system = two_state_reactor()
    inputs = np.array([[290.0], [295.0], [300.0]])
    trajectory = simulate(system, [0.9, 320.0], inputs, 0.5, substeps=4)
    samples = sample_derivatives(system, trajectory)
    assert (samples.x.shape, samples.u.shape) == ((12, 2), (12, 1))
    np.testing.assert_array_equal(samples.x, trajectory.states[:-1])
    np.testing.assert_array_equal(samples.u[:, 0], np.repeat([290.0, 295.0, 300.0], 4))
    np.testing.assert_array_equal(samples.x_dot, system.derivative(samples.x, samples.u))


def test_rate_at_a_step_is_that_of_the_input_from_there_on():
    system = one_state_reactor()
    trajectory = simulate(system, system.nominal_state, [[300.0], [290.0]], 1.0)
    samples = sample_derivatives(system, trajectory)
    np.testing.assert_allclose(samples.x_dot[:, 0], [0.0, -10.0 * system.B[0, 0]], atol=1e-6)


def test_several_trajectories_are_joined():
    system = one_state_reactor()
    inputs = np.array([[[290.0], [295.0]], [[300.0], [285.0]]])
    trajectory = simulate_many(system, [[310.0], [320.0]], inputs, 0.5)
    samples = sample_derivatives(system, trajectory)
    np.testing.assert_array_equal(samples.x[2:], trajectory.states[1, :-1])
    np.testing.assert_array_equal(samples.u[:, 0], [290.0, 295.0, 300.0, 285.0])


def test_samples_without_input():
    samples = sample_derivatives(
        scalar_example(), simulate(scalar_example(), [0.5], np.zeros((3, 0)), 0.1))
    assert samples.u.shape == (3, 0)
    np.testing.assert_array_equal(samples.x_dot, samples.x ** 2)


def test_samples_of_another_system_are_refused():
    trajectory = simulate(scalar_example(), [0.5], np.zeros((3, 0)), 0.1)
    with pytest.raises(ValueError, match=r'incompatible u: expected \(\.\.\., 1\), got \(3, 0\)'):
        sample_derivatives(one_state_reactor(), trajectory)


def test_trajectory_is_read_only():
    trajectory = simulate(scalar_example(), [0.5], np.zeros((3, 0)), 0.1)
    for array in (trajectory.times, trajectory.states, trajectory.inputs):
        assert not array.flags.writeable


@pytest.mark.parametrize(('times', 'states', 'message'), [
    (3, (4, 2), r'incompatible times: expected \(4,\), got \(3,\)'),
    (4, (3, 2), r'incompatible states: expected \(4, 2\), got \(3, 2\)'),
    (4, (5, 4, 2), r'incompatible states: expected \(4, 2\), got \(5, 4, 2\)'),
])
def test_shapes_must_agree(times, states, message):
    with pytest.raises(ValueError, match=message):
        Trajectory(times=np.zeros(times), states=np.zeros(states), inputs=np.zeros((3, 1)))
