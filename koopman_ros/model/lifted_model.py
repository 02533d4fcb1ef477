# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The learned model at run time: dx/dt = f(x) + B(x) u + E d with its derivatives, in NumPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array, frozen, pseudo_inverse, short_repr, show_printed
from koopman_ros.core.datasets import PlantDescription
from koopman_ros.core.integration import adaptive, fastest_rate, integrate, STEPS
from koopman_ros.core.solvers import decaying
from koopman_ros.core.units import (
    check_time_unit,
    display_unit,
    printed,
    SECONDS_PER_TIME_UNIT,
    shown,
)
from koopman_ros.model.coordinates import Coordinates, NO_SIGNALS
from koopman_ros.model.input_matrix import InputTerms
from koopman_ros.model.observables import NetworkObservables, Observables
from koopman_ros.model.provenance import Provenance
from koopman_ros.model.rate_band import RateBand
from koopman_ros.model.training_data import TrainingStates, VerifiedLoops
from koopman_ros.model_classes import (
    FREE_LIFT,
    IDENTITY_LIFT,
    LINEAR,
    NEURAL_DRIFT,
    POLYNOMIAL,
)

LONGEST_DEAD_TIME = 3600.0  #: s
#: of the state that is the applied value of an input behind a lag, before the input's name
APPLIED = 'applied_'
#: of the state that is the command of an input, whose rate a law sets
COMMANDED = 'commanded_'

# Figures on held-out data in words, by their names in files.
_FIGURES = {'cond': 'Condition number', 'rw': 'Held-out residual of the lift, relative',
            'rx': 'Held-out residual of the drift, relative', 'coverage': 'Cells visited',
            'sample_interval': 'Sample interval of the record [s]'}
_FIGURES_OF_STATES = {'rollout_rmse': 'Held-out roll-out error (RMS)',
                      'noise': 'Measurement noise', 'free_run': 'Free-run error (RMS)'}
_SAMPLES = 256  # random states of a box whose training states are not known
# Of Gauss and Legendre on [0, 1].
NODES, WEIGHTS = 0.5 * np.add(leggauss(5), [[1.0], [0.0]])


@dataclass(frozen=True)
class LiftedModel:
    """
    A lift z = N(x) with dz/dt = A z + J_N(x) B(x) u (paper, equation for control-affine systems).

    B is constant without `input_terms`. Measured disturbances d add J_N(x) E d, 0 at their nominal
    values; unlike inputs they are not manipulated.

    With a pre-feedback K the lift is one of the plant under it, f(x) + B K x, for which there is
    an A where the plant alone is unstable: dz/dt = A z - J_N(x) B K x + J_N(x) B(x) u. Inputs and
    drift stay those of the plant.

    All methods work in scaled deviations from the nominal point (see :class:`Coordinates`),
    with time in `time_unit`. With a network without hidden units it is a linearisation. It is
    made by :func:`learn` or read from a file:

    >>> model = load('two_tanks.safetensors')
    >>> model.states.names, model.inputs.units
    (('level_1', 'level_2'), ('V', 'V'))

    :raises ValueError: naming the array that does not fit and both shapes.
    """

    observables: Observables  #: the lift N, with N(0) = 0
    A: Array  #: (n_z, n_z) in 1/time unit
    B: Array  #: (n_x, n_u) in scaled coordinates, at the nominal point
    states: Coordinates  #: the states' names, units, scaling and training box
    inputs: Coordinates  #: the inputs' names, units, scaling and training box
    time_unit: str  #: ``'s'`` or ``'min'``
    provenance: Provenance  #: origin, held-out figures and acceptance
    #: states of the training data within their box; None when they are not known
    training_states: TrainingStates | None = None
    #: (n_x, n_phi) weights of the features phi in the drift, in 1/time unit; None where the drift
    #: follows from the rate of z
    readout: Array | None = None
    input_terms: InputTerms | None = None  #: the state-dependent part of B(x); None for none
    #: (n_u, n_x) gain K of the pre-feedback that A holds under, in scaled coordinates, or None
    pre_feedback: Array | None = None
    #: closed loops of the model's law; None where they are not known, or none failed
    verified_loops: VerifiedLoops | None = None
    #: by how much the rate of the drift may be wrong; None where no record said so
    rate_band: RateBand | None = None
    #: (n_u,) dead time of each input in s, from its application to its effect; or one for all
    dead_time: Array = field(default_factory=lambda: np.zeros(()))
    #: the measured disturbances' names, units, nominal values, scaling and training range
    disturbances: Coordinates = NO_SIGNALS
    #: (n_x, n_d) effect of the disturbances on the rate, in scaled coordinates; None without any
    E: Array | None = None
    #: names of the states that are measured, as in the training record; none for all but applied
    #: inputs behind a lag
    states_measured: tuple[str, ...] = ()

    __repr__ = short_repr
    _repr_pretty_ = show_printed

    def __str__(self) -> str:
        """Show the plant, the trained ranges, the rates, the held-out figures and the verdict."""
        about = self.provenance
        lines = [f'{self.kind}; learned from {about.plant}']
        for role, of in (('state', self.states), ('input', self.inputs),
                         ('measured disturbance', self.disturbances)):
            for name, unit, low, high in zip(
                    of.names, of.units, of.lower.tolist(), of.upper.tolist(), strict=True):
                lines.append(f'{role} {name}: trained from {shown(low, unit):.6g} to '
                             f'{shown(high, unit):.6g} {display_unit(unit)}')
        lines += [f'{what} of {name}: {seconds:.6g} s' for what, values in (
            ('dead time', self.dead_time), ('lag', self.lag)) for j, (name, seconds) in enumerate(
                zip(self.inputs.names, values.tolist(), strict=True))
            if seconds > 0.0 and not (what == 'lag' and j in self.commanded)]
        lines += [f'the law sets the rate of {self.inputs.names[j]}' for j in self.commanded]
        lines += [f'characteristic of {name}: {one}'
                  for name, one in self.inputs.characteristics.items()]
        rates = self.eigenvalues.real
        lines += [f'rates of A: {rates[-1]:.4g} to {rates[0]:.4g} per {self.time_unit}',
                  *(f'{title[0].lower()}{title[1:]}: {value:.3g}'
                    for title, value in self.figures.items()),
                  *[f'simulated closed loops: {about.closed_loops}'] * bool(about.closed_loops),
                  f'acceptance: {about.acceptance}']
        return '\n  '.join(lines)

    def __post_init__(self) -> None:
        n_x, n_u, n_z = self.n_x, self.n_u, self.observables.n_z
        check_time_unit(self.time_unit)
        if self.observables.n_x != n_x:
            raise ValueError(f'incompatible observables: expected {n_x} states, got '
                             f'{self.observables.n_x}')
        for name, shape in (('A', (n_z, n_z)), ('B', (n_x, n_u)), ('pre_feedback', (n_u, n_x)),
                            ('readout', (n_x, self.observables.features.n_z))):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen(value, name, shape))
        object.__setattr__(self, 'E', frozen(
            np.zeros((n_x, 0)) if self.E is None else self.E, 'E', (n_x, len(self.disturbances))))
        dead = frozen(self.dead_time if np.ndim(self.dead_time) else np.full(n_u, self.dead_time),
                      'dead_time', (n_u,))
        object.__setattr__(self, 'dead_time', dead)
        for name, seconds in zip(self.inputs.names, dead.tolist(), strict=True):
            if not 0.0 <= seconds <= LONGEST_DEAD_TIME:
                raise ValueError(f'the dead time of {name} must be 0 to {LONGEST_DEAD_TIME:g} s, '
                                 f'got {seconds:g} s')
        if list(self.states_measured) != [name for name in self.states.names
                                          if name in self.states_measured]:
            raise ValueError('states_measured must be some of the states '
                             f'{", ".join(self.states.names)}, each once and in this order, got '
                             f'{", ".join(self.states_measured)}')
        if self.input_terms is not None and (
                self.input_terms.coefficients.shape[1:] != self.B.shape):
            raise ValueError(f'incompatible input terms: expected {("any", *self.B.shape)}, got '
                             f'{self.input_terms.coefficients.shape}')
        for name, width in (
                ('training_states', self.training_states and self.training_states.n_x),
                ('verified_loops', self.verified_loops and self.verified_loops.n_x),
                ('rate_band', self.rate_band and self.rate_band.n_x)):
            if width is not None and width != n_x:
                raise ValueError(f'incompatible {name}: expected {n_x} states, got {width}')

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the training, by their names in words, with units."""
        titles = dict(_FIGURES)
        for key, title in _FIGURES_OF_STATES.items():
            for name, unit in zip(self.states.names, self.states.units, strict=True):
                titles[f'{key}_{name}'] = f'{title}, {name.replace("_", " ")} [{printed(unit)}]'
                titles[key] = f'{title} [{printed(unit)}]'
        # these have no lift
        left_out = ('rw',) if self.kind in (LINEAR, NEURAL_DRIFT) else ()
        return {titles.get(name, name): value for name, value in self.provenance.metrics.items()
                if name not in left_out}

    @cached_property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.states)

    @cached_property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @cached_property
    def n_z(self) -> int:
        """Number of lifted coordinates."""
        return self.A.shape[0]

    @cached_property
    def identity(self) -> bool:
        """Whether z starts with the state."""
        return self.observables.identity

    @cached_property
    def states_alone(self) -> bool:
        """Whether its functions are the states alone, as in a linear model."""
        return self.observables.features.n_z == self.n_x

    @cached_property
    def kind(self) -> str:
        """Its class for people, of a lift with the number of coordinates."""
        lift, name = self.observables, self.provenance.model_class
        if not name:
            name = (POLYNOMIAL if not isinstance(lift, NetworkObservables) else
                    LINEAR if not len(lift.W) else
                    FREE_LIFT if not lift.identity else
                    NEURAL_DRIFT if self.readout is not None and self.n_z == self.n_x else
                    IDENTITY_LIFT)
        return f'{name}, n_z = {self.n_z}' if name in (IDENTITY_LIFT, FREE_LIFT) else name

    @cached_property
    def measured(self) -> list[int]:
        """Indices of the states that are measured, unless a controller is given `outputs`."""
        return [i for i, name in enumerate(self.states.names) if (
            name in self.states_measured if self.states_measured
            else i not in self.lagged.values())]

    @cached_property
    def lagged(self) -> dict[int, int]:
        """Indices of the inputs behind a lag, each with that of the state it applies."""
        return {**self._states_of(APPLIED), **self.commanded}

    @cached_property
    def commanded(self) -> dict[int, int]:
        """Those of them that the controller itself moves: the state is the command."""
        return self._states_of(COMMANDED)

    def _states_of(self, prefix: str) -> dict[int, int]:
        names = self.states.names
        return {j: names.index(prefix + name) for j, name in enumerate(self.inputs.names)
                if prefix + name in names}

    @cached_property
    def modes(self) -> NDArray[np.complex128]:
        """Modes (n_x,) of the drift at the nominal point in 1/s."""
        slope = self.drift_jacobian(np.zeros(self.n_x)) / self.seconds_per_time_unit
        return np.linalg.eigvals(slope).astype(np.complex128)

    @cached_property
    def lag(self) -> Array:
        """Time constant (n_u,) of each input in s; 0 without a lag."""
        slope, found = self.drift_jacobian(np.zeros(self.n_x)), np.zeros(self.n_u)
        for j, i in self.lagged.items():
            found[j] = -self.seconds_per_time_unit / slope[i, i]
        return found

    @cached_property
    def sample_interval(self) -> float:
        """
        Time in s between the samples of the training record.

        For a model without a record a tenth of its fastest time constant, at most 1 s.
        """
        fastest = self.linearised.fastest_rate / self.seconds_per_time_unit
        return self.provenance.metrics.get('sample_interval') or (
            1.0 if fastest <= 0.1 else 0.1 / fastest)

    @property
    def plant(self) -> PlantDescription:
        """The names, units and nominal point of its plant, without B."""
        return PlantDescription(self.provenance.plant, self.states.names, self.states.units,
                                self.inputs.names, self.inputs.units, self.time_unit,
                                self.states.center,
                                self.inputs.center, None, self.input_matrix_degree,
                                characteristics=self.inputs.characteristics)

    @cached_property
    def seconds_per_time_unit(self) -> float:
        """Length of the model's time unit in seconds."""
        return SECONDS_PER_TIME_UNIT[self.time_unit]

    @cached_property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues (n_z,) of A in 1/time unit, slowest (largest real part) first."""
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return values[np.argsort(-values.real, kind='stable')]

    def disturbance_rate(self, d: Array) -> Array:
        """Evaluate E d, the rate due to disturbances (..., n_d), in their units: (..., n_x)."""
        assert self.E is not None
        return self.disturbances.to_deviation(d) @ self.E.T

    def with_disturbances(self, names: Sequence[str]) -> LiftedModel:
        """
        Return the model in which some inputs are measured disturbances.

        :raises ValueError: for an unknown name, an effect that depends on the state, a model under
            a pre-feedback, or a disturbance with a dead time.
        """
        if not names:
            return self
        disturbances, terms, K = self.inputs.only(names), self.input_terms, self.pre_feedback
        order = [self.inputs.names.index(name) for name in names]
        kept = [i for i in range(self.n_u) if i not in order]
        if (terms is not None and terms.coefficients[..., order].any()) or (
                K is not None and K[order].any()):
            raise ValueError(
                f'the effect of {", ".join(names)} must not depend on the state: set '
                'input_matrix_degree to 0, and learn without pre-feedback')
        if self.dead_time[order].any():
            raise ValueError(f'a measured disturbance has no dead time, got '
                             f'{self.dead_time[order].tolist()} s for {", ".join(names)}')
        assert self.E is not None
        return replace(
            self, B=self.B[:, kept], dead_time=self.dead_time[kept],
            inputs=self.inputs.only(tuple(self.inputs.names[i] for i in kept)),
            input_terms=terms and InputTerms(terms.coefficients[..., kept]),
            pre_feedback=None if K is None else K[kept],
            disturbances=self.disturbances.followed_by(disturbances),
            E=np.hstack([self.E, self.B[:, order]]))

    @cached_property
    def joined(self) -> LiftedModel:
        """The model in which the measured disturbances are further inputs, the last ones."""
        if not len(self.disturbances):
            return self
        assert self.E is not None
        terms, n_d = self.input_terms, len(self.disturbances)
        return replace(
            self, B=np.hstack([self.B, self.E]), disturbances=NO_SIGNALS, E=None,
            inputs=self.inputs.followed_by(self.disturbances),
            dead_time=np.concatenate([self.dead_time, np.zeros(n_d)]),
            input_terms=terms and InputTerms(np.pad(
                terms.coefficients, ((0, 0), (0, 0), (0, n_d)))),
            pre_feedback=None if self.pre_feedback is None else np.pad(
                self.pre_feedback, ((0, n_d), (0, 0))))

    def predict(self, x0: Array, inputs: Array, sample_period: float | Array, *,
                most: int = 1000, diverged: float = 1e6) -> Array:
        """
        Simulate the states under inputs that are held: dx/dt = f(x) + B(x) u.

        Measured disturbances have their nominal values; :attr:`joined` takes others.

        :param x0: (..., n_x) start, in state units; leading dimensions are predicted side by side.
        :param inputs: (..., K, n_u) inputs, each held for one sample period, in input units, from
            the time at which they act on: :attr:`dead_time` does not count.
        :param sample_period: in the model's time unit, or (K,) periods.
        :param most: steps in a sample; a model a thousand times faster needs a fifth.
        :param diverged: distance from the nominal point, in units of the scale, at which a
            prediction has diverged.
        :return: (..., K + 1, n_x) states at the samples, in state units.
        :raises RuntimeError: when the prediction diverges.
        :raises ValueError: for arrays that do not fit the model, or periods that are not above 0.
        """
        inputs = self.inputs.array('inputs', inputs)
        xi = self.states.to_deviation(self.states.array('x0', x0))
        shape = xi.shape
        if inputs.ndim != xi.ndim + 1:
            raise ValueError(f'incompatible inputs: expected ({", ".join(map(str, shape[:-1]))}'
                             f'{", " if shape[:-1] else ""}K, {self.n_u}), got {inputs.shape}')
        holds = inputs.shape[-2]
        periods = np.asarray(sample_period, dtype=np.float64)
        if periods.shape not in ((), (holds,)) or not np.all(periods > 0.0):
            raise ValueError(f'sample_period must be above 0 {self.time_unit}, one number or one '
                             f'for each of {holds} inputs, got {sample_period}')
        v = self.inputs.to_deviation(inputs)
        path = [xi]
        for k, period in enumerate(np.broadcast_to(periods, (holds,))):
            # a prediction that overflows is reported below
            with np.errstate(all='ignore'):
                rate = self.rate_under(v[..., k, :])

                def flat(_: float, y: Array, rate: Callable[[Array], Array] = rate) -> Array:
                    return rate(y.reshape(shape)).ravel()

                # near a state where J_N is singular the steps may become ever shorter
                end, arrived = adaptive(flat, xi.ravel(), period, rtol=1e-9, atol=1e-12,
                                        most=most)
            xi = end.y.reshape(shape)
            if not (arrived and np.all(np.abs(xi) < diverged)):
                raise RuntimeError(f'the prediction diverged after {len(path)} samples: keep the '
                                   'inputs within the trained range')
            path.append(xi)
        return self.states.to_physical(np.stack(path, axis=-2))

    @cached_property
    def fastest_rate(self) -> float:
        """Largest size of an eigenvalue of A in 1/time unit."""
        return float(np.max(np.abs(self.eigenvalues)))

    @cached_property
    def is_hurwitz(self) -> bool:
        """Whether every mode of A decays."""
        return bool(decaying(self.eigenvalues).all())

    @cached_property
    def adds_unstable_modes(self) -> bool:
        """
        Whether A has more modes that do not decay than the linearised model.

        Both under the pre-feedback, if there is one.
        """
        slope = self.linearised.A + self.pre_feedback_slope
        grow = [int(np.sum(~decaying(eigenvalues)))
                for eigenvalues in (self.eigenvalues, np.linalg.eigvals(slope))]
        return grow[0] > grow[1]

    @cached_property
    def mismatch(self) -> float:
        """
        Error of A z as the rate J_N f of z under the model's drift f: 0 for a closed lift.

        Under the pre-feedback, if there is one. As the training figure ``rw`` a mean square
        without unit, over the training states or random ones of the box; 0 also for a lift at
        rest everywhere.
        """
        if self.training_states is not None:
            x = self.training_states.states
        else:
            box = self.states
            x = box.to_deviation(np.random.default_rng(0).uniform(
                box.lower, box.upper, (_SAMPLES, self.n_x)))
        z, J = self.lift_and_jacobian(x)
        rate = (J @ (self.drift(x) + self.pre_feedback_rate(x))[..., None])[..., 0]
        rest = rate - z @ self.A.T
        whitening = pseudo_inverse(z.T @ z)
        size = float(np.sum(rate @ whitening * rate))
        return float(np.sum(rest @ whitening * rest)) / size if size > 0.0 else 0.0

    @property
    def input_matrix_degree(self) -> int:
        """Degree of the polynomial B(x); 0 where it is constant."""
        return 0 if self.input_terms is None else self.input_terms.degree

    @cached_property
    def _nominal_inverse(self) -> Array:
        return frozen(pseudo_inverse(self.B), 'inverse of B', (self.n_u, self.n_x))

    def input_inverse(self, x: Array | None = None) -> Array:
        """Return the pseudo-inverse (n_u, n_x) of B(x) at a state (n_x,), or the nominal one."""
        if x is None or self.input_terms is None:
            return self._nominal_inverse
        return pseudo_inverse(self.input_matrix(x))

    def input_matrix(self, x: Array) -> Array:
        """Evaluate B(x): (..., n_x) -> (..., n_x, n_u); one (n_x, n_u) where it is constant."""
        return self.B if self.input_terms is None else self.B + self.input_terms.matrix(x)

    def forcing(self, x: Array, u: Array) -> Array:
        """Evaluate B(x) u, the rate due to inputs: (..., n_x), (..., n_u) -> (..., n_x)."""
        if self.input_terms is None:
            return u.dot(self.B.T)
        return (self.input_matrix(x) @ u[..., None])[..., 0]

    def forcing_jacobian(self, x: Array, u: Array) -> Array:
        """Evaluate d(B(x) u)/dx, (..., n_x), (..., n_u) -> (..., n_x, n_x); 0 for a constant B."""
        if self.input_terms is None:
            return np.zeros((self.n_x, self.n_x))
        return self.input_terms.jacobian(x, u)

    def rate_and_slope(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Evaluate f(x) + B(x) u (..., n_x) and its derivative by x (..., n_x, n_x)."""
        f, J = self.drift_and_jacobian(x)
        if self.input_terms is None:
            return f + u.dot(self.B.T), J
        return f + self.forcing(x, u), J + self.forcing_jacobian(x, u)

    def rate_under(self, u: Array, w: Array | float = 0.0) -> Callable[[Array], Array]:
        """
        Return the rate of the state under a held input, x -> f(x) + B(x) u + w.

        :param u: (..., n_u) scaled deviations.
        :param w: (..., n_x) disturbance.
        """
        if self.input_terms is None:
            constant = u.dot(self.B.T) + w
            return lambda x: self.drift(x) + constant
        return lambda x: self.drift(x) + self.forcing(x, u) + w

    def integrated(self, x: Array, u: Array, w: Array, seconds: float) -> Array | None:
        """
        Integrate the state (n_x,) under a held input and a disturbance.

        :param u: (n_u,) scaled deviations, and w (n_x,).
        :return: None after so long that it takes too many steps.
        """
        rate, (duration, steps) = self.rate_under(u, w), self.integration_steps(x, u, seconds)
        return None if steps is None else integrate(rate, x, duration, steps)

    def integration_steps(self, x: Array, u: Array, seconds: float) -> tuple[float, int | None]:
        """
        Return an interval in time units and the steps that it takes, or None for too many.

        The fastest mode is that at the state or at the nominal point, to which it may return.
        """
        duration = seconds / self.seconds_per_time_unit
        local = fastest_rate(self.rate_and_slope(x, u)[1])
        # passes on a NaN, as the comparisons of Python do not
        fastest = float(np.maximum(local, self.linearised.fastest_rate))
        return duration, STEPS.count(duration, fastest)

    @cached_property
    def linearised(self) -> LiftedModel:
        """The model linearised at its nominal point: dx/dt = (df/dx)(0) x + B(0) u."""
        slope = self.drift_jacobian(np.zeros(self.n_x))
        return replace(self, observables=NetworkObservables.linear(self.n_x), A=slope,
                       readout=None, input_terms=None, pre_feedback=None, verified_loops=None)

    def failed_near(self, x: Array, x_ref: Array) -> bool:
        """
        Whether the law failed in the tested loop nearest to a state and a set-point.

        Both (n_x,) in scaled deviations; see :attr:`verified_loops`.
        """
        return self.verified_loops is not None and self.verified_loops.failed_near(
            x, x_ref, self.states.half_widths)

    def distance(self, x: Array) -> float:
        """Return the distance of a state (n_x,), in state units, as :meth:`distances`."""
        outside = self.states.violation(self.states.array('state', x))
        return outside if self.training_states is None else max(outside, float(
            self.training_states.distance(self.states.to_deviation(x), self.states.half_widths)))

    def distances(self, x: Array) -> Array:
        """
        Return the distances of states from the training data.

        :param x: (N, n_x) in scaled deviations.
        :return: (N,) in half-ranges of the training box: the larger of the distance from the box
            and, where they are known, from the training states; infinity for a state that is not
            finite.
        """
        half, (lower, upper) = self.states.half_widths, self.states.corners
        outside = np.maximum(np.maximum(lower - x, x - upper) / half, 0.0).max(axis=1)
        if self.training_states is not None:
            outside = np.maximum(outside, self.training_states.distance(x, half))
        return np.where(np.isnan(outside), np.inf, outside)

    def lift(self, x: Array) -> Array:
        """Evaluate z = N(x): (..., n_x) -> (..., n_z); ValueError for another size."""
        return self.observables.lift(self.states.array('state', x))

    def jacobian(self, x: Array) -> Array:
        """Evaluate J_N(x) = dN/dx: (..., n_x) -> (..., n_z, n_x)."""
        return self.lift_and_jacobian(x)[1]

    def lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate N(x) and J_N(x) at once."""
        return self.observables.lift_and_jacobian(self.states.array('state', x))

    def onto_states(self, J: Array) -> Array:
        """Return the pseudo-inverse of J_N(x): (..., n_z, n_x) -> (..., n_x, n_z)."""
        if self.identity and J.shape[-1] == 1:
            # one state: a tenth of the time of a singular value decomposition
            row: Array = J.swapaxes(-1, -2)
            return row / (row @ J)
        return pseudo_inverse(J)

    @cached_property
    def _weights(self) -> Array | None:
        """Weights (n_x, n_phi) of the features in the drift; None if it is not linear in them."""
        return self.A - self.pre_feedback_slope if self.readout is None and (
            self.states_alone and self.identity) else self.readout

    def drift(self, x: Array) -> Array:
        """Evaluate f, the rate of the state without inputs: (..., n_x) -> same; f(0) = 0."""
        if not isinstance(x, np.ndarray) or x.shape[-1:] != (self.n_x,):
            x = self.states.array('state', x)
        if self._weights is not None:
            return self.observables.features.lift(x).dot(self._weights.T)
        z, J = self.observables.lift_and_jacobian(x)
        f: Array = (self.onto_states(J) @ z.dot(self.A.T)[..., None])[..., 0]
        return f if self.pre_feedback is None else f - self.pre_feedback_rate(x)

    @cached_property
    def pre_feedback_slope(self) -> Array:
        """B K (n_x, n_x); zeros where there is no pre-feedback."""
        shape = (self.n_x, self.n_x)
        slope = np.zeros(shape) if self.pre_feedback is None else self.B @ self.pre_feedback
        return frozen(slope, 'slope of the pre-feedback', shape)

    def pre_feedback_rate(self, x: Array) -> Array:
        """Evaluate B K x, the part of A z that is due to the pre-feedback: (..., n_x) -> same."""
        return x @ self.pre_feedback_slope.T

    def drift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Evaluate the drift and its Jacobian exactly: (..., n_x) -> same, (..., n_x, n_x)."""
        if self._weights is not None:
            features, slope = self.observables.features.lift_and_jacobian(x)
            return features @ self._weights.T, self._weights @ slope
        z, J, bend = self.observables.lift_and_derivatives(x)
        inverse, rate = self.onto_states(J), (z @ self.A.T)[..., None]
        f = inverse @ rate
        # the derivative of J'J f = J'A z by each state, with J of full rank
        rest = (bend * (rate - J @ f)[..., None]).sum(axis=-3)
        slope = inverse @ (self.A @ J - (bend @ f[..., None, :, :])[..., 0]
                           + inverse.swapaxes(-1, -2) @ rest)
        if self.pre_feedback is None:
            return f[..., 0], slope
        return f[..., 0] - self.pre_feedback_rate(x), slope - self.pre_feedback_slope

    def drift_jacobian(self, x: Array) -> Array:
        """Evaluate df/dx of the drift exactly: (..., n_x) -> (..., n_x, n_x)."""
        return self.drift_and_jacobian(x)[1]

    def averaged_drift_jacobian(self, x: Array, x_ref: Array) -> Array:
        """
        Average df/dx along the segment from x_ref to x, both (n_x,).

        :return: A (n_x, n_x) with f(x) - f(x_ref) = A (x - x_ref): exact for a read-out, by the
            secants of its features, otherwise close, by Gauss-Legendre quadrature.
        """
        if self.readout is not None:
            return self.readout @ self.observables.features.secants(x, x_ref, x)[1]
        along = self.drift_jacobian(x_ref + NODES[:, None] * (x - x_ref))
        return np.tensordot(WEIGHTS, along, 1)


def linearised_model(jacobian: Array, B: Array, states: Coordinates, inputs: Coordinates,
                     time_unit: str, provenance: Provenance) -> LiftedModel:
    """
    Build the linear model dx/dt = (df/dx)(x - x_0) + B (u - u_0) as a lift with N(x) = x.

    :param jacobian: (n_x, n_x) df/dx at the nominal point, the centers, in units.
    :param B: (n_x, n_u) input matrix, in units.
    """
    n_x = len(states)
    A = np.asarray(jacobian) * states.scale / states.scale[:, None]
    scaled_B = np.asarray(B) * inputs.scale / states.scale[:, None]
    return LiftedModel(NetworkObservables.linear(n_x), A, scaled_B, states, inputs, time_unit,
                       provenance)
