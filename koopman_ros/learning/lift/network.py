# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The network of a lift in torch: value, rate along a drift, and derivatives by its parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
import math

import torch
from torch import Tensor


@dataclass(frozen=True)
class Parameters:
    """The parameters of a lift by name, as views of one flat vector."""

    W: Tensor  #: (h, n_x) weights of the hidden layer
    b: Tensor  #: (h,) its biases
    V: Tensor  #: (n_free, h) output weights
    A: Tensor  #: (n_z, n_z) dynamics
    B: Tensor | None = None  #: (n_x, n_u) input matrix where it is learned, else None
    #: (W (g, n_z), b (g,), V (n_x, g), c (n_x,)) where there is a decoder network, else None
    decoder: tuple[Tensor, Tensor, Tensor, Tensor] | None = None


@dataclass(frozen=True)
class Layout:
    """
    Sizes of a lift N(x; p) and the places of its parameters in one flat vector.

    N(x) = [x; V (h(x) - h(0))] with identity coordinates and without x otherwise, where
    h(x) = tanh(W x + b). The vector stacks W, b, V, A, B and the decoder, row by row.
    """

    n_x: int  #: number of states
    n_z: int  #: number of lifted coordinates
    hidden: int  #: units of the hidden layer
    identity: bool  #: whether z starts with the state
    n_u: int = 0  #: number of inputs whose B is learned, 0 where B is known
    decoder: int = 0  #: units of the decoder network x = D(z; q), 0 for none

    @property
    def n_free(self) -> int:
        """Number of coordinates the network provides."""
        return self.n_z - self.n_x if self.identity else self.n_z

    @cached_property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of the parameters in their order in the vector."""
        h, g = self.hidden, self.decoder
        return ((h, self.n_x), (h,), (self.n_free, h), (self.n_z, self.n_z),
                *[(self.n_x, self.n_u)] * bool(self.n_u),
                *[(g, self.n_z), (g,), (self.n_x, g), (self.n_x,)] * bool(g))

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Place of each parameter in the vector."""
        ends = accumulate(map(math.prod, self.shapes), initial=0)
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @property
    def size(self) -> int:
        """Length of the vector."""
        return self.slices[-1].stop

    def split(self, theta: Tensor) -> Parameters:
        """Return the parameters as views of the flat vector."""
        parts = [theta[place].view(shape)
                 for place, shape in zip(self.slices, self.shapes, strict=True)]
        return Parameters(parts[0], parts[1], parts[2], parts[3], parts[4] if self.n_u else None,
                          (parts[-4], parts[-3], parts[-2], parts[-1]) if self.decoder else None)

    def join(self, p: Parameters) -> Tensor:
        """Stack the parameters into one flat vector."""
        parts = [p.W, p.b, p.V, p.A, *([] if p.B is None else [p.B]), *(p.decoder or ())]
        return torch.cat([part.reshape(-1) for part in parts])


class Pass:
    """
    One pass of N samples through the hidden layer, with the rates along a drift.

    Verified against automatic differentiation.

    :param x: (N, n_x) scaled states.
    :param f: (N, n_x) rate of change of the states.
    """

    def __init__(self, layout: Layout, parameters: Parameters, x: Tensor, f: Tensor) -> None:
        W, b, V = parameters.W, parameters.b, parameters.V
        self._layout, self._x = layout, x
        value, zero, through = torch.tanh(torch.addmm(b, x, W.T)), torch.tanh(b), f @ W.T
        self.slope = 1.0 - value * value  #: (N, h) of tanh
        self.slope_rate = -2.0 * value * self.slope * through  #: (N, h)
        self.zero_slope = 1.0 - zero * zero  #: (h,) at x = 0
        self.features = value - zero  #: (N, h) the layer less its value at 0
        self.feature_rates = self.slope * through  #: (N, h)
        free, free_rate = self.features @ V.T, self.feature_rates @ V.T
        self.z = torch.cat([x, free], 1) if layout.identity else free
        self.z_rate = torch.cat([f, free_rate], 1) if layout.identity else free_rate

    def pull_back(self, into: Tensor, coefficients: Tensor) -> None:
        """
        Differentiate coefficients . features by the hidden layer.

        :param into: (N, R, p) receives the derivatives at the places of W and b.
        :param coefficients: (R, h), or (N, R, h), of R rows.
        """
        at_W, at_b = self._layout.slices[:2]
        to_input = coefficients * self.slope[:, None, :]
        torch.mul(to_input[..., None], self._x[:, None, None, :],
                  out=into[:, :, at_W].unflatten(2, self._layout.shapes[0]))
        into[:, :, at_b] = to_input - coefficients * self.zero_slope
