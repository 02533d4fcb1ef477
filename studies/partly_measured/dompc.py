# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
do-mpc on a case: its nonlinear MPC and its moving horizon estimator, on the true equations.

See F. Fiedler et al., "do-mpc: Towards FAIR nonlinear and robust model predictive control",
Control Engineering Practice 140 (2023).
"""

from typing import Any
import warnings

import casadi
import numpy as np

from koopman_ros.control.mpc import MPCParameters, RecedingHorizon
from koopman_ros.core.arrays import Array
from koopman_ros.estimation import Estimate, ExtendedKalmanFilter
from studies.equations import EQUATIONS
from studies.partly_measured.cases import PartialCase

# It calls functions of numpy on values of casadi, which would warn of what is to come.
casadi.GlobalOptions.setNumpyMode(-1)
# of those tried among the quickest on every plant
_IPOPT: dict[str, Any] = {
    'ipopt.print_level': 0, 'ipopt.sb': 'yes', 'print_time': 0, 'ipopt.tol': 1e-4,
    'ipopt.warm_start_init_point': 'yes', 'ipopt.mu_init': 1e-3}
_PENALTY = 1e3  # of a violated limit of a state, in its scale
_WINDOW = 20  # samples that the estimator looks back
_SETTLING = 400  # samples after which a filter's covariance stands still


def _do_mpc() -> Any:
    """Import do-mpc, which takes 2 s, only where it plans."""
    with warnings.catch_warnings():
        # it tells what it would do with other packages
        warnings.simplefilter('ignore', UserWarning)
        import do_mpc
    return do_mpc


class DoMpcPlanner:
    """
    Its nonlinear MPC towards a set-point: collocation at its defaults, warm-started IPOPT.

    Weights, range, sample time and length of the horizon are those of the law `mpc`, as is the
    cost to go at its end; a limit of a state is soft. The cost counts at the samples.
    """

    def __init__(self, case: PartialCase) -> None:
        self._case, n, n_u = case, case.system.n_x, case.system.n_u
        self._model = _model(case, measuring=False)
        self._planner = planner = _do_mpc().controller.MPC(self._model)
        interval = case.period / case.system.seconds_per_time_unit
        planner.settings.n_horizon = horizon(case)
        planner.settings.t_step = interval
        planner.settings.nlpsol_opts = dict(_IPOPT)
        x, u, to = (self._model.x['x'], self._model.u['u'], self._model.tvp['to'])
        e, v = x - to[:n], u - to[n:]
        planner.set_objective(
            lterm=interval * (casadi.dot(case.Q * e, e) + casadi.dot(case.R * v, v)),
            mterm=e.T @ case.cost_to_go @ e)
        planner.set_rterm(u=np.zeros(n_u))
        planner.bounds['lower', '_u', 'u'] = case.lower
        planner.bounds['upper', '_u', 'u'] = case.upper
        planner.scaling['_x', 'x'] = scale = case.truth.states.scale
        planner.scaling['_u', 'u'] = case.truth.inputs.scale
        for i in np.flatnonzero(np.isfinite(case.state_upper)).tolist():
            planner.set_nl_cons(f'upper_{i}', x[i] / scale[i], ub=case.state_upper[i] / scale[i],
                                soft_constraint=True, penalty_term_cons=_PENALTY)
        self._ahead, self._known = planner.get_tvp_template(), planner.get_p_template(1)
        planner.set_tvp_fun(lambda _: self._ahead)
        planner.set_p_fun(lambda _: self._known)
        self.aim(*case.goal(case.system), np.zeros(case.directions.shape[1]))
        planner.setup()
        self._started = False

    def aim(self, x_ref: Array, u_ref: Array, d: Array) -> None:
        """Take another target and the disturbances (n_d,) that it is held under."""
        self._ahead['_tvp', :, 'to'] = np.concatenate((x_ref, u_ref))
        self._known['_p', 0, 'd'] = d

    def step(self, x: Array) -> Array:
        """Return the first input (n_u,) of its plan from a state (n_x,)."""
        if not self._started:
            self._planner.x0, self._planner.u0 = x, self._case.start[1]
            self._planner.set_initial_guess()
            self._started = True
        return np.asarray(self._planner.make_step(x)).ravel()


class WithFilter:
    """Its MPC with the extended Kalman filter of this package and the true model."""

    def __init__(self, case: PartialCase) -> None:
        self._case, self._planner, self._filter = case, DoMpcPlanner(case), true_filter(case)
        self._estimate: Estimate | None = None
        self._u = case.start[1]

    def step(self, y: Array, setpoint: Array) -> Array:
        """Return the input (n_u,) for outputs (n_y,) of the next sample, and a set-point."""
        case, model, known = self._case, self._case.truth, self._estimate
        u = model.inputs.to_deviation(self._u)
        if known is None:
            x = model.states.to_deviation(_guess(case, y))
            self._estimate = found = self._filter.restart(None, x, u)
        else:
            predicted = self._filter.predict(known, u, case.period)
            assert predicted is not None
            x = model.states.to_deviation(case.outputs.state(
                y, model.states.to_physical(predicted.x)))
            self._estimate = found = self._filter.correct(predicted, x, case.period)
        w = found.w * model.states.scale
        self._planner.aim(*case.target(setpoint, w), np.linalg.pinv(case.directions) @ w)
        self._u = self._planner.step(model.states.to_physical(found.x))
        return self._u


class WithWindow:
    """Its MPC on its own moving horizon estimator, of state and constant disturbances."""

    def __init__(self, case: PartialCase) -> None:
        self._case, self._planner = case, DoMpcPlanner(case)
        self._model = _model(case, measuring=True)
        self._window = window = _do_mpc().estimator.MHE(self._model, ['d'])
        window.settings.n_horizon = _WINDOW
        window.settings.t_step = case.period / case.system.seconds_per_time_unit
        window.settings.meas_from_data = True
        window.settings.nlpsol_opts = dict(_IPOPT)
        # what a Kalman filter knows before a sample, when it has settled at the set-point
        prior = _settled(case)
        n = case.system.n_x
        window.set_default_objective(
            np.linalg.inv(prior[:n, :n]), np.diag(case.noise ** -2.0),
            np.linalg.inv(prior[n:, n:]))
        window.scaling['_x', 'x'] = case.truth.states.scale
        window.scaling['_u', 'u'] = case.truth.inputs.scale
        window.setup()
        self._u, self._started = case.start[1], False

    def step(self, y: Array, setpoint: Array) -> Array:
        """Return the input (n_u,) for outputs (n_y,) of the next sample, and a set-point."""
        case = self._case
        if not self._started:
            self._window.x0, self._window.u0 = _guess(case, y), self._u
            self._window.p_est0 = np.zeros(case.directions.shape[1])
            self._window.set_initial_guess()
            self._started = True
        x = np.asarray(self._window.make_step(np.concatenate((y, self._u)))).ravel()
        d = np.asarray(self._window.p_est0.cat).ravel()
        self._planner.aim(*case.target(setpoint, case.directions @ d), d)
        self._u = self._planner.step(x)
        return self._u


def horizon(case: PartialCase) -> int:
    """Return how many samples the law `mpc` looks ahead."""
    law = RecedingHorizon(case.truth, case.tuning(case.truth), MPCParameters())
    assert law.planner is not None
    lengths = law.planner.grid(case.period).lengths
    return round(float(np.sum(lengths) / lengths[0]))


def true_filter(case: PartialCase) -> ExtendedKalmanFilter:
    """Return the filter that a controller of this package has with the true model."""
    model = case.truth
    return ExtendedKalmanFilter(model, case.outputs, case.tuning(model), None)


def _guess(case: PartialCase, y: Array) -> Array:
    """Return the initial estimate: the outputs, and the nominal point for the rest."""
    return case.outputs.state(y, case.system.nominal_state)


def _model(case: PartialCase, *, measuring: bool) -> Any:
    """Return the plant with disturbances along some directions, as a model of do-mpc."""
    n, n_u = case.system.n_x, case.system.n_u
    model = _do_mpc().model.Model('continuous', 'SX')
    x = model.set_variable('_x', 'x', shape=(n, 1))
    u = model.set_variable('_u', 'u', shape=(n_u, 1))
    d = model.set_variable('_p', 'd', shape=(case.directions.shape[1], 1))
    if measuring:
        model.set_meas('y', case.outputs.C @ x, meas_noise=True)
        model.set_meas('applied', u, meas_noise=False)
    else:
        model.set_variable('_tvp', 'to', shape=(n + n_u, 1))
    model.set_rhs('x', EQUATIONS[case.plant](x, u) + case.directions @ d)
    model.setup()
    return model


def _settled(case: PartialCase) -> Array:
    """Return the filter's covariance of state and disturbances before a sample, in their units."""
    one, model = true_filter(case), case.truth
    x, u = case.goal(case.system)
    at, held = model.states.to_deviation(x), model.inputs.to_deviation(u)
    estimate = Estimate(at, np.zeros(model.n_x), one.initial_covariance)
    for _ in range(_SETTLING):
        predicted = one.predict(one.correct(estimate, at, case.period), held, case.period)
        assert predicted is not None
        estimate = predicted
    assert estimate.covariance is not None
    scale, onto = model.states.scale, np.linalg.pinv(case.directions)
    whole = estimate.covariance * np.outer(*(np.tile(scale, 2),) * 2)
    into = np.block([[np.eye(model.n_x), np.zeros((model.n_x,) * 2)],
                     [np.zeros((len(onto), model.n_x)), onto]])
    return np.asarray(into @ whole @ into.T)
