# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""States from which a limited input can bring a plant back, against what is known by hand."""

import numpy as np
import pytest

from koopman_ros.plants import (
    box_episodes,
    ControlAffineSystem,
    RandomStepDesign,
    recoverable,
)


def linear(A, B):
    A, B = np.array(A), np.array(B)
    names = tuple(f'x{i}' for i in range(len(A)))
    return ControlAffineSystem(
        'linear', names, ('1',) * len(A), tuple(f'u{i}' for i in range(B.shape[1])),
        ('1',) * B.shape[1], 's', lambda x: x @ A.T,
        B, np.zeros(len(A)), np.zeros(B.shape[1]),
        drift_jacobian=lambda x: np.broadcast_to(A, (*x.shape, len(A))))


UNSTABLE = linear([[1.0]], [[1.0]])
BOX = {'input_lower': -1.0, 'input_upper': 1.0, 'state_lower': -2.0, 'state_upper': 2.0}


def test_an_unstable_mode_is_recoverable_within_the_authority_of_the_input():
    """Of x' = x + u, |u| <= 1, these are |x| < 1."""
    x = np.linspace(-1.99, 1.99, 200)[:, None]
    np.testing.assert_array_equal(recoverable(UNSTABLE, x, **BOX), np.abs(x[:, 0]) < 1.0)


def test_a_mass_that_cannot_stop_within_its_box_is_lost():
    """From x1 with a speed x2 > 0 it comes to x1 + x2^2 / 2, whatever |u| <= 1 does."""
    mass = linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    x = np.random.default_rng(0).uniform(-2.0, 2.0, (400, 2))
    found = recoverable(mass, x, **BOX)
    furthest = np.abs(x[:, 0] + 0.5 * x[:, 1] * np.abs(x[:, 1]))
    assert not np.any(found[furthest > 2.0])
    assert np.all(found[np.max(np.abs(x), axis=1) < 0.5])
    assert 0.3 < np.mean(found) < 0.9


def test_states_outside_the_box_or_not_finite_are_lost():
    x = np.array([[2.1], [np.nan], [0.0]])
    np.testing.assert_array_equal(recoverable(UNSTABLE, x, **BOX), [False, False, True])


def test_episodes_stay_where_the_input_outweighs_the_plant():
    design = RandomStepDesign(-1.0, 1.0, -1.5, 1.5, (0.1, 0.2), 0.1, max_redraws=2)
    kept, plain = (box_episodes(UNSTABLE, design, 40, 0.5, 0, keep_recoverable=keep)
                   for keep in (True, False))
    assert np.max(np.abs(kept.x)) < 1.0 < np.max(np.abs(plain.x))
    # and reach nearly as far
    assert np.max(np.abs(kept.x)) > 0.9
    assert len(kept) == len(plain)


@pytest.mark.parametrize(('system', 'change', 'message'), [
    (UNSTABLE, {'state_upper': -1.0}, r'state_lower \[-2\.\] and state_upper \[-1\.\] must lie on '
                                      'both sides of the nominal state'),
    (UNSTABLE, {'input_lower': 0.0}, 'must lie on both sides of the nominal input'),
    (UNSTABLE, {'state_lower': -np.inf}, 'state_lower'),
    (linear([[1.0]], [[0.0]]), {}, 'no state feedback stabilises')])
def test_ranges_and_plants_without_recoverable_states_are_errors(system, change, message):
    with pytest.raises(ValueError, match=message):
        recoverable(system, np.zeros((1, 1)), **{**BOX, **change})
