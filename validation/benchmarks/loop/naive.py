# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The controller's law written down with general tools: torch's jacrev and control's lqr."""

import numpy as np
import torch
from torch.func import jacrev

import control
from koopman_ros.arrays import Array
from koopman_ros.control import Settings
from koopman_ros.lifting import LiftedModel, NetworkObservables

# Where the state is so near to its reference, the secant of the Jacobian is its derivative.
_NEAR = 1e-6


class NaiveLaw:
    """
    The re-centred law with the disturbance observer, for one state and one input, in float64.

    :param model: a lift that starts with the state and whose modes decay; slow beside a sample.
    :param settings: weights, limits and the observer's bandwidth.
    """

    def __init__(self, model: LiftedModel, settings: Settings) -> None:
        network = model.observables
        assert isinstance(network, NetworkObservables)
        self._layers = [(torch.tensor(W), torch.tensor(b)) for W, b in network.hidden]
        self._output = torch.tensor(network.output)
        self._model, self._limits = model, settings.limits
        self._Q = np.diag(settings.state_weight * model.states.scale ** 2)
        self._R = np.diag(settings.input_weight * model.inputs.scale ** 2)
        self._C = np.eye(1, model.n_z)
        self._at_zero = self._activations(torch.zeros(1, dtype=torch.float64))
        self._jacobian = jacrev(self._lift_twice, has_aux=True)
        self._second = jacrev(jacrev(self._lift))
        self._bandwidth = settings.observer_bandwidth
        self._setpoint = np.full(1, np.nan)
        self._x, self._w = np.full(1, np.nan), np.zeros(1)
        self._command: Array | None = None

    def step(self, measurement: Array, setpoint: Array, seconds: float) -> Array:
        """
        Answer one measurement.

        :param measurement: (1,) in K.
        :param setpoint: (1,) that is tracked, in K.
        :param seconds: since the measurement before.
        :return: (1,) the command in K.
        """
        model = self._model
        x = self._observed(model.states.to_deviation(measurement), seconds)
        x_ref = model.states.to_deviation(setpoint)
        if setpoint != self._setpoint:
            self._setpoint = setpoint
            self._z_ref, self._J_ref = self._lift_and_jacobian(x_ref)
            self._f_ref = self._drift(x_ref)
        u_ref = np.linalg.solve(model.B, -self._f_ref - self._w)
        z, J = self._lift_and_jacobian(x)
        H = self._secant(x, x_ref, J) @ (model.B @ u_ref + self._w)[:, None]
        K, _, _ = control.lqr(model.A + H @ self._C, J @ model.B, self._C.T @ self._Q @ self._C,
                              self._R)
        u = np.clip(model.inputs.to_physical(u_ref - K @ (z - self._z_ref)),
                    self._limits.lower, self._limits.upper)
        if self._command is not None:
            reach = self._limits.rate * seconds
            u = np.clip(u, self._command - reach, self._command + reach)
        self._command = u
        return u

    def _observed(self, x: Array, seconds: float) -> Array:
        """Return the observer's state (1,), which predicts by one step of Heun's method."""
        if self._command is None:
            self._x = x
            return x
        h = seconds / self._model.seconds_per_time_unit
        push = self._model.B @ self._model.inputs.to_deviation(self._command) + self._w
        slope = self._drift(self._x) + push
        predicted = self._x + 0.5 * h * (slope + self._drift(self._x + h * slope) + push)
        p = np.exp(-self._bandwidth * seconds)
        self._w = self._w + (1.0 - p) ** 2 / h * (x - predicted)
        self._x = predicted + (1.0 - p ** 2) * (x - predicted)
        return self._x

    def _drift(self, x: Array) -> Array:
        z, J = self._lift_and_jacobian(x)
        found: Array = np.linalg.pinv(J) @ self._model.A @ z
        return found

    def _secant(self, x: Array, x_ref: Array, J: Array) -> Array:
        """Return (J(x) - J(x_ref)) / (x - x_ref), (n_z, 1)."""
        distance = float(x[0] - x_ref[0])
        if abs(distance) < _NEAR:
            second: Array = self._second(torch.from_numpy(x)).numpy()[:, :, 0]
            return second
        return (J - self._J_ref) / distance

    def _lift_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        J, z = self._jacobian(torch.from_numpy(x))
        return z.numpy(), J.numpy()

    def _activations(self, x: torch.Tensor) -> torch.Tensor:
        for W, b in self._layers:
            x = torch.tanh(W @ x + b)
        return x

    def _lift(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat((x, self._output @ (self._activations(x) - self._at_zero)))

    def _lift_twice(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        z = self._lift(x)
        return z, z
