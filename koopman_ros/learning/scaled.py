# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples in the scaled deviations that a lift sees, as arrays and as tensors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from koopman_ros.lifting import Box
from koopman_ros.plant_data import Array, Samples


def deviations(box: Box, samples: Samples) -> tuple[Array, Array, Array]:
    """Scale samples to deviations: x (N, n_x), dx/dt (N, n_x), u (N, n_u)."""
    return (box.states.to_deviation(samples.x), samples.dxdt / box.states.scale,
            box.inputs.to_deviation(samples.u))


@dataclass(frozen=True)
class ScaledSamples:
    """Samples that a lift is learned from, in scaled deviations from the nominal point."""

    x: Tensor  #: (N, n_x) states, float64
    f: Tensor  #: (N, n_x) rates dx/dt, less B u where B is known
    u: Tensor | None = None  #: (N, n_u) inputs whose B is to be learned, or None where it is known

    def drift(self, B: Tensor | None) -> Tensor:
        """Return the rates without what the inputs do, (N, n_x)."""
        return self.f if B is None or self.u is None else self.f - self.u @ B.T

    def part(self, start: int, length: int) -> ScaledSamples:
        """Return some consecutive samples."""
        rows = slice(start, start + length)
        return ScaledSamples(self.x[rows], self.f[rows],
                             None if self.u is None else self.u[rows])

    def __len__(self) -> int:
        return len(self.x)
