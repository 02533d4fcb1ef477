# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Samples that stay with the workers that read them: sums over them come back, nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import functools
import hashlib
from pathlib import Path
import pickle
from typing import Any

import numpy as np
import torch
from torch import Tensor

from koopman_ros.jobs.backends import Backend
from koopman_ros.learning.lift.neural_drift import readout_rows
from koopman_ros.learning.lift.residuals import Problem, ScaledSamples, Sums
from koopman_ros.learning.lift.scaling import Scaling
from koopman_ros.learning.lift.threads import torch_threads
from koopman_ros.lifting import LiftedModel
from koopman_ros.plant_data import Array, Samples


@dataclass(frozen=True)
class Shard:
    """How a worker reads a part of the samples; small, for it is sent in their place."""

    name: str  #: for messages, one of its own
    #: returns the samples, found by a worker under its name in a module, or sent by value
    read: Callable[..., Samples]
    arguments: tuple[Any, ...] = ()  #: of it, like the path of a file that the worker sees


def write_samples(path: Path | str, samples: Samples) -> None:
    """Write samples to a file ``.npz``, for :func:`read_samples`."""
    arrays = {name: value for name in ('x', 'dxdt', 'u', 'episode', 'time')
              if (value := getattr(samples, name)) is not None}
    np.savez(path, allow_pickle=False, **arrays)


def read_samples(path: Path | str) -> Samples:
    """
    Read samples from a file ``.npz``.

    :raises ValueError: naming the file, for one of another content.
    """
    with np.load(path, allow_pickle=False) as file:
        if missing := {'x', 'dxdt', 'u', 'episode'} - set(file):
            raise ValueError(f'{path} has no {", ".join(sorted(missing))}: write it with '
                             'koopman_ros.learning.write_samples')
        return Samples(**{name: file[name] for name in (
            'x', 'dxdt', 'u', 'episode', 'time') if name in file})


@dataclass(frozen=True)
class _Extent:
    """What is known of a shard without its samples."""

    count: int
    #: (2, n_x) and (2, n_u) lowest and highest values
    x: Array
    u: Array
    digest: str


class KeptShards:
    """
    Shards that the workers of a backend have read, for :class:`ScaledSamples`.

    :raises ValueError: for names that repeat, or shards of other signals than the plant's.
    """

    def __init__(self, backend: Backend, shards: Sequence[Shard]) -> None:
        items = {shard.name: shard for shard in shards}
        if len(items) != len(shards) or not shards:
            raise ValueError('each shard needs a name of its own, got '
                             f'{[shard.name for shard in shards]}')
        self._kept = backend.keep(_Samples, items)
        self._call: dict[str, Any] = {}
        try:
            self._extents = self._kept.run(_extent, None)
        except BaseException:
            self._kept.close()
            raise
        for name, extent in zip(items, self._extents, strict=True):
            sizes, wanted = ((one.x.shape[1], one.u.shape[1])
                             for one in (extent, self._extents[0]))
            if sizes != wanted:
                raise ValueError(f'{name} has {sizes[0]} states and {sizes[1]} inputs, the first '
                                 f'shard {wanted[0]} and {wanted[1]}')

    def __len__(self) -> int:
        """Return the number of samples."""
        return sum(extent.count for extent in self._extents)

    @property
    def corners(self) -> tuple[Array, Array]:
        """Lowest and highest states (2, n_x) and inputs (2, n_u)."""
        x, u = (np.stack([getattr(extent, name) for extent in self._extents]) for name in 'xu')
        return (np.stack([x[:, 0].min(axis=0), x[:, 1].max(axis=0)]),
                np.stack([u[:, 0].min(axis=0), u[:, 1].max(axis=0)]))

    @property
    def digest(self) -> str:
        """SHA-256 of those of the shards, in their order, in hexadecimal."""
        return hashlib.sha256(''.join(one.digest for one in self._extents).encode()).hexdigest()

    def scaled(self, scaling: Scaling, device: str, threads: int) -> None:
        """Say how samples are scaled, and where and by how many threads sums are formed."""
        self._call = {'scaling': pickle.dumps(scaling), 'device': device, 'threads': threads}

    def sums(self, problem: Problem, theta: Tensor, derivatives: bool) -> Sums:
        """Sum over all samples at parameters (p,): shard by shard, whoever has them."""
        parts = self._kept.run(_sums, _Call(**self._call, problem=problem, theta=theta.cpu(),
                                            derivatives=derivatives, N=len(self)))
        return tuple(functools.reduce(torch.add, of_all).to(theta.device)
                     for of_all in zip(*parts, strict=True))

    def readout_rows(self, model: LiftedModel) -> Array:
        """
        Return what the read-out of a model is fitted to, as far as a least-squares fit goes by it.

        The triangles of a QR decomposition of each shard's rows, one below the other: their
        squares sum to the same, and a fit to them is as accurate.
        """
        return np.concatenate(self._kept.run(_triangle, model))

    def close(self) -> None:
        """Let the workers forget them."""
        self._kept.close()


@dataclass(frozen=True)
class _Call:
    """What goes to the workers with each evaluation."""

    scaling: bytes
    device: str
    threads: int
    problem: Problem
    theta: Tensor
    derivatives: bool
    N: int


class _Samples:
    """The samples of a shard, where they were read."""

    def __init__(self, shard: Shard) -> None:
        self.samples = shard.read(*shard.arguments)
        self._scaled: tuple[bytes, str, ScaledSamples] | None = None

    @property
    def nbytes(self) -> int:
        """Their size in bytes."""
        samples = self.samples
        return sum(a.nbytes for a in (samples.x, samples.dxdt, samples.u, samples.episode))

    def scaled(self, scaling: bytes, device: str) -> ScaledSamples:
        if self._scaled is None or self._scaled[:2] != (scaling, device):
            found: Scaling = pickle.loads(scaling)
            self._scaled = scaling, device, found.data(self.samples, device)
        return self._scaled[2]


def _extent(own: _Samples, _: None) -> _Extent:
    x, u = (np.stack([a.min(axis=0), a.max(axis=0)]) for a in (own.samples.x, own.samples.u))
    return _Extent(len(own.samples), x, u, own.samples.digest())


def _triangle(own: _Samples, model: LiftedModel) -> Array:
    triangle: Array = np.linalg.qr(readout_rows(model, own.samples)).R
    return triangle


def _sums(own: _Samples, call: _Call) -> Sums:
    with torch_threads(call.threads):
        data = own.scaled(call.scaling, call.device)
        sums = call.problem.on(data).sums(call.theta.to(data.x.device), call.derivatives, call.N)
        return tuple(part.cpu() for part in sums)
