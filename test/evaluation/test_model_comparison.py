# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recent measurements, and which models predict them no worse than the current one."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import Controller, InputLimits, Tuning
from koopman_ros.control.events import Measurement
from koopman_ros.control.state import Arrival, MeasurementReport
from koopman_ros.core.signals import Outputs
from koopman_ros.evaluation import model_comparison
from koopman_ros.evaluation.model_comparison import (
    MeasurementBuffer,
    ModelComparison,
    PredictionWindows,
)
from koopman_ros.model import Coordinates, LiftedModel, linearised_model, Provenance
from support.closed_loops import SECOND
from support.sampling import sampled

ACCEPTED, REJECTED = MeasurementReport(Arrival.ACCEPTED), MeasurementReport(Arrival.REJECTED)
A, B = np.array([[-0.02, 0.01], [0.0, -0.05]]), np.array([[0.0], [0.1]])


def model(A: np.ndarray = A, B: np.ndarray = B) -> LiftedModel:
    """Return dx/dt = A x + B u of two states, in s."""
    x, u = (Coordinates(names, ('1',) * n, np.full(n, 3.0), np.full(n, 2.0), np.zeros(n),
                        np.full(n, 6.0))
            for names, n in ((('x1', 'x2'), 2), (('u',), 1)))
    return linearised_model(A, B, x, u, 's', Provenance('two lags'))


def one(model: LiftedModel, outputs: Outputs | None = None) -> Controller:
    limits = InputLimits(model.inputs.lower, model.inputs.upper, np.full(model.n_u, np.inf))
    return Controller(model, Tuning.for_model(
        model, state_weight=np.ones(model.n_x), input_weight=np.ones(model.n_u), limits=limits,
        measurement_noise=0.01, disturbance_noise=1e-3 * np.sqrt(60.0)),
        outputs)


def compare(present: LiftedModel, candidate: LiftedModel, windows: PredictionWindows,
            outputs: Outputs | None = None) -> ModelComparison | None:
    return model_comparison.compare(one(present, outputs), one(candidate, outputs), windows)


def recent(x: np.ndarray, u: np.ndarray, length: float, seconds: float = 1.0) -> MeasurementBuffer:
    """Remember samples (N, n_x), before each of which inputs (N, n_u) acted."""
    found = MeasurementBuffer()
    for k, (value, held) in enumerate(zip(x, u, strict=True)):
        found.add(Measurement(round((1 + k * seconds) * SECOND), value), ACCEPTED, held, length)
    return found


def two_lags(u: np.ndarray, A: np.ndarray = A, B: np.ndarray = B) -> np.ndarray:
    """Respond to deviations (N, 1) of the input from 3, held over the second before each."""
    step, gain = sampled(A, B, 1.0)
    x = np.zeros((len(u), 2))
    for k in range(1, len(u)):
        x[k] = step @ x[k - 1] + gain @ u[k]
    return x


def random_steps(count: int, seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, (count // 20 + 1, 1)), 20,
                     axis=0)[:count]


def test_errors_are_those_of_the_best_start_and_disturbance():
    """Against the exact response of the wrong model, and a least-squares fit of each window."""
    u = random_steps(101)
    x = two_lags(u)
    windows = recent(x + 3.0, u + 3.0, 100.0).windows(100.0)
    K = 20
    assert windows.places.tolist() == [
        list(range(start, start + K)) for start in range(80, -1, -10)]
    wrong = -0.5 * B
    found = windows.squares(model(B=wrong), np.array([1.0, 4.0]))
    weights = np.array([1.0, 0.25])
    for squares, (first, *_) in zip(found, windows.places, strict=True):
        part = np.concatenate([np.zeros((1, 1)), u[first + 1:first + K + 1]])
        alone = two_lags(part, B=wrong)
        constant = np.concatenate([np.zeros((1, 1)), np.ones((K, 1))])
        columns = [two_lags(constant, B=unit[:, None]) for unit in np.eye(2)]
        decay, _ = sampled(A, B, 1.0)
        columns += [np.array([np.linalg.matrix_power(decay, k) @ unit for k in range(K + 1)])
                    for unit in np.eye(2)]
        fit = np.stack([(column * weights).ravel() for column in columns], axis=1)
        target = ((alone - x[first:first + K + 1]) * weights).ravel()
        rest = target - fit @ np.linalg.lstsq(fit, target, rcond=None)[0]
        expected = np.mean(np.square(rest.reshape(K + 1, 2) / weights), axis=0)
        # the trapezoidal rule errs by (0.05 s / s)^2 / 12 in each step
        np.testing.assert_allclose(np.sqrt(squares), np.sqrt(expected), rtol=0.01, atol=1e-4)
    np.testing.assert_allclose(np.sqrt(windows.squares(model(), np.ones(2))), 0.0, atol=1e-4)


@pytest.mark.parametrize(('other', 'accepted', 'noise'), [
    (model(), True, 0.0), (model(B=-B), False, 0.0), (model(A=1e300 * A), False, 0.0), *(
        (other, accepted, 0.01) for other, accepted in (
            (model(B=1.1 * B), True), (model(A=1.2 * A), True), (model(B=-B), False),
            (model(B=0.0 * B), False), (model(B=5.0 * B), False), (model(A=-A), False),
            (model(A=20.0 * A), False), (model(B=1e300 * B), False)))])
def test_models_are_compared_only_by_moving_signals(other, accepted, noise):
    u = random_steps(301, 1)
    x = two_lags(u) + noise * np.random.default_rng(2).normal(size=(301, 2))
    found = compare(model(), other, recent(x + 3.0, u + 3.0, 200.0).windows(200.0))
    assert found.tells
    assert found.seconds == 200.0
    assert bool(np.all(found.ratio <= 2.0)) is accepted


@pytest.mark.parametrize(('known', 'accepted'), [(4.5, True), (5.0, True), (0.0, False)])
def test_models_are_compared_with_their_dead_time(known, accepted):
    u = random_steps(301, 1)
    late = two_lags(np.concatenate((np.tile(u[:1], (5, 1)), u[:-5])))
    present, candidate = (replace(model(), dead_time=np.array([dead])) for dead in (5.0, known))
    found = compare(present, candidate, recent(late + 3.0, u + 3.0, 200.0).windows(200.0))
    assert found.tells
    assert bool(np.all(found.ratio <= 2.0)) is accepted


@pytest.mark.parametrize('outputs', [None, Outputs(('x1',), ('1',), np.array([[1.0, 0.0]]))])
@pytest.mark.parametrize(('factor', 'accepted'), [(1.02, True), (0.0, False), (-1.0, False)])
def test_models_are_compared_with_their_measured_disturbances(factor, accepted, outputs):
    def disturbed(factor):
        d = Coordinates(('d',), ('1',), *np.array([[5.0], [2.0], [3.0], [7.0]]))
        return replace(model(), disturbances=d, E=factor * E)

    u, d = random_steps(201), random_steps(201, 1)
    E = np.array([[0.05], [0.0]])
    # before a sample acts what was measured at its end
    x = two_lags(u) + two_lags(d, B=E) + 3.0
    found = MeasurementBuffer()
    for k, (value, held, acting) in enumerate(zip(
            x if outputs is None else x[:, :1], u + 3.0, d + 5.0, strict=True)):
        found.add(Measurement(round((1 + k) * SECOND), value), ACCEPTED, held, 200.0, acting)
    ratio = compare(disturbed(1.0), disturbed(factor), found.windows(200.0), outputs).ratio
    assert bool((ratio < 2.0).all()) is accepted


def test_memory_is_bounded_and_averages_the_inputs():
    """Of samples 1 ms apart a row in ten is kept, with the mean of five ups and five downs."""
    u = np.tile([[2.0], [0.0]], (2000, 1))
    x = np.arange(4000.0)[:, None]
    windows = recent(x, u, 1.0, 1e-3).windows(1.0)
    assert windows.x.ravel().tolist() == list(range(3000, 4000, 10))
    np.testing.assert_allclose(windows.u, 1.0, rtol=1e-12)
    np.testing.assert_allclose(windows.steps, 0.01, rtol=1e-9)
    assert windows.places.shape == (8, 20)


def samples(found: MeasurementBuffer, times: range, report: MeasurementReport = ACCEPTED,
            u: np.ndarray | None = None, applied: np.ndarray | None = None) -> MeasurementBuffer:
    for time in times:
        found.add(Measurement(time * SECOND, np.array([float(time)]), applied), report,
                  np.zeros(1) if u is None else u, 100.0)
    return found


def cut(found: MeasurementBuffer, seconds: float = 40.0) -> PredictionWindows:
    windows = found.windows(seconds)
    assert windows is not None
    return windows


def test_too_little_is_no_window():
    assert MeasurementBuffer().windows(40.0) is None
    assert samples(MeasurementBuffer(), range(1, 9)).windows(40.0) is None
    assert cut(samples(MeasurementBuffer(), range(1, 10))).places.tolist() == [list(range(8))]
    # a fifth of what is to be remembered
    assert samples(MeasurementBuffer(), range(1, 20)).windows(100.0) is None
    # rare measurements are all there is
    assert cut(samples(MeasurementBuffer(), range(100, 1000, 100))).places.shape == (1, 8)


def test_a_clock_set_back_or_an_unknown_input_begins_a_new_episode():
    assert cut(samples(samples(MeasurementBuffer(), range(50, 90)),
                       range(1, 10))).x.ravel().tolist() == list(
        range(1, 10))
    found = samples(MeasurementBuffer(), range(1, 30))
    found.add(Measurement(30 * SECOND, np.array([30.0])), ACCEPTED, None, 100.0)
    assert found.windows(40.0) is None


def test_no_window_spans_a_gap():
    windows = cut(samples(samples(MeasurementBuffer(), range(1, 12)), range(20, 40)))
    assert np.max(windows.steps) == 9.0
    assert np.all(windows.steps[windows.places] == 1.0)
    assert len(windows.places) == 4


def test_rejected_measurement_leaves_its_input_and_late_ones_nothing():
    found = samples(MeasurementBuffer(), range(1, 10))
    samples(found, range(10, 11), REJECTED, np.ones(1))
    samples(found, range(9, 10), MeasurementReport(Arrival.LATE), np.full(1, 9.0))
    windows = cut(samples(found, range(11, 12)))
    assert windows.x.ravel().tolist() == [*range(1, 10), 11]
    assert windows.u.ravel().tolist() == [0.0] * 8 + [0.5]


def test_measured_input_counts_where_it_is_a_number():
    found = samples(MeasurementBuffer(), range(1, 6), u=np.ones(1), applied=np.full(1, 2.0))
    samples(found, range(6, 11), u=np.ones(1), applied=np.full(1, np.nan))
    assert cut(found).u.ravel().tolist() == [2.0] * 4 + [1.0] * 5
