# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What counts as a spike or a jump, and what is a plant's own motion."""

import numpy as np
import pytest

from koopman_ros.bags.series import spikes_and_jumps
from koopman_ros.plants import one_state_reactor, random_steps, RandomStepDesign

DESIGN = RandomStepDesign(281.33, 300.55, 305.0, 327.0, (0.5, 2.0), 1.0 / 60.0, rtol=1e-9)


@pytest.fixture(scope='module')
def motion() -> np.ndarray:
    """Return twenty minutes of the reactor under random steps, a sample a second [degC]."""
    states = random_steps(one_state_reactor(), DESIGN, 20.0, 5).x
    return states[:, 0] - 273.15


@pytest.mark.parametrize('noise', [0.0, 0.1, 1.0])
@pytest.mark.parametrize('stride', [1, 10, 30])
def test_motion_under_steps_is_neither(motion: np.ndarray, noise: float, stride: int) -> None:
    values = motion[::stride] + noise * np.random.default_rng(1).standard_normal(
        len(motion[::stride]))
    spike, jump = spikes_and_jumps(values, 1.0)
    assert not spike.any()
    assert not jump.any()


@pytest.mark.parametrize('noise', [0.0, 0.1])
def test_spikes_and_jumps_are_found(motion: np.ndarray, noise: float) -> None:
    values = motion + noise * np.random.default_rng(2).standard_normal(len(motion))
    values[[100, 700]] += [40.0, -35.0]
    values[900:] += 30.0
    spike, jump = spikes_and_jumps(values, 1.0)
    assert np.flatnonzero(spike).tolist() == [100, 700]
    assert np.flatnonzero(jump).tolist() == [900]


@pytest.mark.parametrize(('values', 'jumps'), [
    # a step of the input after a long rest
    (51.0 - 10.0 * (1.0 - np.exp(-np.maximum(np.arange(3000.0) - 2950.0, 0.0) / 25.0)), []),
    # a reset while all rests, and one that is too small
    (np.r_[np.full(200, 40.0), np.full(200, 51.0)], [200]),
    (np.r_[np.full(200, 40.0), np.full(200, 40.9)], []),
    # few samples tell nothing
    (np.r_[np.zeros(20), 100.0, np.zeros(20)], [])])
def test_jumps_after_a_rest(values: np.ndarray, jumps: list[int]) -> None:
    spike, jump = spikes_and_jumps(values, 1.0)
    assert not spike.any()
    assert np.flatnonzero(jump).tolist() == jumps
