# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The lift as a torch network: value, directional derivative, and their parameter derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
import math

import torch
from torch import Tensor

# value, first and second derivative at once
Activation = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]


def _tanh(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    t = torch.tanh(a)
    d = 1.0 - t * t
    return t, d, -2.0 * t * d


def _sigmoid(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    s = torch.sigmoid(a)
    d = s * (1.0 - s)
    return s, d, d * (1.0 - 2.0 * s)


def _sine(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    s = torch.sin(a)
    return s, torch.cos(a), -s


def _softplus(a: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    s = torch.sigmoid(a)
    return torch.logaddexp(a, torch.zeros_like(a)), s, s * (1.0 - s)


# the names are those of koopman_ros.lifting.activations, which evaluates them at run time
ACTIVATIONS: dict[str, Activation] = {
    'tanh': _tanh, 'sigmoid': _sigmoid, 'sine': _sine, 'softplus': _softplus}


def check_activation(name: str) -> None:
    """Raise ValueError, listing the known names, when an activation is not one of them."""
    if name not in ACTIVATIONS:
        raise ValueError(f'activation must be one of {", ".join(ACTIVATIONS)}, got {name!r}')


@dataclass(frozen=True)
class Parameters:
    """The parameters of a lift by name, as views of one flat vector."""

    #: (W (h_i, h_{i-1}), b (h_i,)) of each hidden layer, h_0 = n_x
    hidden: tuple[tuple[Tensor, Tensor], ...]
    V: Tensor  #: (n_free, h) output weights
    A: Tensor  #: (n_z, n_z) dynamics
    B: Tensor | None = None  #: (n_x, n_u) input matrix where it is learned, else None
    #: (W (g, n_z), b (g,), V (n_x, g), c (n_x,)) where there is a decoder network, else None
    decoder: tuple[Tensor, Tensor, Tensor, Tensor] | None = None


@dataclass(frozen=True)
class Layout:
    """
    Sizes of a lift N(x; p) and the places of its parameters in one flat vector.

    N(x) = [x; V (h(x) - h(0))] with identity coordinates and without x otherwise, where h is the
    last hidden layer. The vector stacks the hidden layers, V, A, B and the decoder, row by row.

    :raises ValueError: on sizes that do not fit or an unknown activation.
    """

    n_x: int  #: number of states
    n_z: int  #: number of lifted coordinates
    hidden: tuple[int, ...]  #: units of each hidden layer
    identity: bool  #: whether z starts with the state
    activation: str = 'tanh'  #: name of the activation, a key of :data:`ACTIVATIONS`
    n_u: int = 0  #: number of inputs whose B is learned, 0 where B is known
    decoder: int = 0  #: units of the decoder network x = D(z; q), 0 for none

    def __post_init__(self) -> None:
        check_activation(self.activation)
        if self.n_free < 0 or min(self.n_x, *self.hidden, 1) < 1:
            raise ValueError(f'sizes do not fit: {self}')

    @property
    def n_free(self) -> int:
        """Number of coordinates the network provides."""
        return self.n_z - self.n_x if self.identity else self.n_z

    @cached_property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of the parameters in their order in the vector."""
        shapes: list[tuple[int, ...]] = []
        width = self.n_x
        for h in self.hidden:
            shapes += [(h, width), (h,)]
            width = h
        shapes += [(self.n_free, width if self.hidden else 0), (self.n_z, self.n_z)]
        if self.n_u:
            shapes.append((self.n_x, self.n_u))
        if self.decoder:
            g = self.decoder
            shapes += [(g, self.n_z), (g,), (self.n_x, g), (self.n_x,)]
        return tuple(shapes)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Place of each parameter in the vector."""
        ends = [0]
        for shape in self.shapes:
            ends.append(ends[-1] + math.prod(shape))
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @property
    def size(self) -> int:
        """Length of the vector."""
        return self.slices[-1].stop

    def split(self, theta: Tensor) -> Parameters:
        """Return the parameters as views of the flat vector."""
        parts = [theta[place].view(shape)
                 for place, shape in zip(self.slices, self.shapes, strict=True)]
        n = 2 * len(self.hidden)
        hidden = tuple((parts[i], parts[i + 1]) for i in range(0, n, 2))
        return Parameters(
            hidden, parts[n], parts[n + 1],
            parts[n + 2] if self.n_u else None,
            (parts[-4], parts[-3], parts[-2], parts[-1]) if self.decoder else None)

    def join(self, parameters: Parameters) -> Tensor:
        """Stack the parameters into one flat vector."""
        parts = [part for layer in parameters.hidden for part in layer]
        parts += [parameters.V, parameters.A]
        if parameters.B is not None:
            parts.append(parameters.B)
        if parameters.decoder is not None:
            parts += parameters.decoder
        return torch.cat([part.reshape(-1) for part in parts])


@dataclass(frozen=True)
class Layer:
    """Values of one layer kept for the backward pass; N samples, widths g -> h."""

    W: Tensor
    value_in: Tensor      #: (N, g)
    rate_in: Tensor       #: (N, g)
    slope: Tensor         #: (N, h) of the activation
    slope_rate: Tensor    #: (N, h) time derivative of the slope
    zero_in: Tensor       #: (g,) the layer's input at x = 0
    zero_slope: Tensor    #: (h,)


class Pass:
    """
    One pass of N samples through the hidden layers, with the rates that a drift gives them.

    With a = W h + b, s = sigma'(a), the rate of a layer's output is s (W h'), and everything
    below follows by the chain rule; verified against automatic differentiation.

    :param x: (N, n_x) scaled states.
    :param f: (N, n_x) rate of change of the states.
    """

    def __init__(self, layout: Layout, parameters: Parameters, x: Tensor, f: Tensor) -> None:
        self._layout, self._parameters = layout, parameters
        activation = ACTIVATIONS[layout.activation]
        value, rate, zero = x, f, x.new_zeros(layout.n_x)
        self.layers: list[Layer] = []
        for W, b in parameters.hidden:
            through = rate @ W.T
            next_value, slope, curvature = activation(torch.addmm(b, value, W.T))
            next_zero, zero_slope, _ = activation(b + W @ zero)
            self.layers.append(Layer(W, value, rate, slope, curvature * through, zero, zero_slope))
            value, rate, zero = next_value, slope * through, next_zero
        # (N, h): the last layer above its value at 0, and its rate
        self.features = value - zero if parameters.hidden else x[:, :0]
        self.feature_rates = rate if parameters.hidden else x[:, :0]
        free, free_rate = self.features @ parameters.V.T, self.feature_rates @ parameters.V.T
        self.z = torch.cat([x, free], 1) if layout.identity else free
        self.z_rate = torch.cat([f, free_rate], 1) if layout.identity else free_rate

    def jacobian(self) -> Tensor:
        """Return J_N (N, n_z, n_x)."""
        layout = self._layout
        N = len(self.z)
        T = torch.eye(layout.n_x).to(self.z).expand(N, -1, -1)
        for layer in self.layers:
            T = layer.slope[:, :, None] * (layer.W @ T)
        free = self._parameters.V @ T if self.layers else T[:, :0]
        if not layout.identity:
            return free
        return torch.cat([torch.eye(layout.n_x).to(self.z).expand(N, -1, -1), free], 1)

    def pull_back(self, into: Tensor, of_features: Tensor, of_rates: Tensor | None) -> None:
        """
        Differentiate r = of_features . features + of_rates . feature_rates in the hidden layers.

        :param into: (N, R, p) receives the derivatives at the places of the hidden layers.
        :param of_features: (R, h), or (N, R, h), coefficients of R rows.
        :param of_rates: (R, h) likewise, or None for none.
        """
        slices = self._layout.slices
        S, T = of_features, of_rates
        S0 = -of_features
        for i in range(len(self.layers) - 1, -1, -1):
            layer = self.layers[i]
            h, g = layer.W.shape
            to_input = S * layer.slope[:, None, :]
            at_W = into[:, :, slices[2 * i]].unflatten(2, (h, g))
            if T is not None:
                to_input = to_input + T * layer.slope_rate[:, None, :]
                to_rate = T * layer.slope[:, None, :]
                at_W[...] = to_rate[..., None] * layer.rate_in[:, None, None, :]
                at_W.addcmul_(to_input[..., None], layer.value_in[:, None, None, :])
            else:
                torch.mul(to_input[..., None], layer.value_in[:, None, None, :], out=at_W)
            zero_to_input = S0 * layer.zero_slope
            into[:, :, slices[2 * i + 1]] = to_input + zero_to_input
            if i:
                at_W += zero_to_input[..., None] * layer.zero_in
                S, S0 = to_input @ layer.W, zero_to_input @ layer.W
                T = None if T is None else to_rate @ layer.W
