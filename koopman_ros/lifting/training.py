# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Training of a lifted model from samples: split, scaling, multi-start growth, held-out report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
import hashlib

from koopman_ros import __version__
from koopman_ros.lifting.growth import grow, Grown, Recipe
from koopman_ros.lifting.levenberg_marquardt import Status
from koopman_ros.lifting.model import Array, Coordinates, LiftedModel, Provenance
from koopman_ros.lifting.validation import Fit, fit
import numpy as np
import torch

# A lift whose drift of the state is off by more than this is worse than none.
_MAX_RX = 0.1


@dataclass(frozen=True)
class Samples:
    """
    States, their derivatives and the inputs that acted, from one or more episodes.

    :param x: (N, n_x) states, in state units.
    :param dxdt: (N, n_x) derivatives, in state units per time unit.
    :param u: (N, n_u) inputs, in input units.
    :param episode: (N,) number of the episode that each sample belongs to.
    :raises ValueError: on unequal lengths or values that are not finite.
    """

    x: Array
    dxdt: Array
    u: Array
    episode: np.ndarray

    def __post_init__(self) -> None:
        for name in ('x', 'dxdt', 'u'):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if array.ndim != 2 or len(array) != len(self.episode):
                raise ValueError(f'incompatible {name}: expected ({len(self.episode)}, n), '
                                 f'got {array.shape}')
            if not np.all(np.isfinite(array)):
                raise ValueError(f'{name} holds {np.count_nonzero(~np.isfinite(array))} values '
                                 'that are not finite: drop those samples')
            object.__setattr__(self, name, array)

    def take(self, episodes: np.ndarray) -> Samples:
        """Return the samples of some episodes."""
        keep = np.isin(self.episode, episodes)
        return Samples(self.x[keep], self.dxdt[keep], self.u[keep], self.episode[keep])

    def digest(self) -> str:
        """Return the SHA-256 of the samples, in hexadecimal."""
        sha = hashlib.sha256()
        for array in (self.x, self.dxdt, self.u, np.asarray(self.episode, dtype=np.int64)):
            sha.update(np.ascontiguousarray(array).astype('<f8').tobytes())
        return sha.hexdigest()


@dataclass(frozen=True)
class Plant:
    """
    What is known of the plant beside its data.

    :param name: name of the plant.
    :param state_names: one name a state.
    :param state_units: one unit a state.
    :param input_names: one name an input.
    :param input_units: one unit an input.
    :param time_unit: ``'s'`` or ``'min'``.
    :param nominal_state: (n_x,) fixed point under the nominal input.
    :param nominal_input: (n_u,) nominal input.
    :param B: (n_x, n_u) input matrix, in units.
    """

    name: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    time_unit: str
    nominal_state: Array
    nominal_input: Array
    B: Array


@dataclass(frozen=True)
class Trained:
    """
    A trained model with what it took.

    :param model: the winner, with its figures on the untouched test episodes in its provenance.
    :param fit: those figures.
    :param status: the sentence with which its training ended.
    :param starts: number of starts that finished.
    """

    model: LiftedModel
    fit: Fit
    status: str
    starts: int


# Called after every step with (start, n_z, iteration, cost); True ends that start early.
Progress = Callable[[int, int, int, float], bool]


def train(plant: Plant, samples: Samples, recipe: Recipe, *, seed: int = 0, starts: int = 4,
          split_seed: int = 0, progress: Progress | None = None) -> Trained:
    """
    Learn a lifted model: grow it from several starts and keep the best on validation episodes.

    A fifth of the episodes chooses the winner and another fifth, touched by nothing else, gives
    the figures reported. Starts use the seeds `seed`, `seed` + 1, ... An interrupt from the
    keyboard ends the training and keeps the best start so far.

    :param plant: names, units, nominal point and B.
    :param samples: at least three episodes.
    :param recipe: what to grow.
    :param seed: seed of the first start.
    :param starts: number of starts.
    :param split_seed: seed of the split into training, validation and test episodes.
    :param progress: called after every step.
    :raises ValueError: on too few episodes, held-out episodes that hardly move, or a recipe that
        does not fit.
    :raises KeyboardInterrupt: when interrupted before the first start finished.
    """
    if starts < 1:
        raise ValueError(f'starts must be at least 1, got {starts}')
    n_x = samples.x.shape[1]
    if recipe.n_z < n_x + recipe.identity:
        raise ValueError(f'n_z = {recipe.n_z} is too small for {n_x} states'
                         + (' as its first coordinates: use linearised_model for a linear model'
                            if recipe.identity else ''))
    parts = split_by_episode(samples, split_seed)
    states, inputs = _coordinates(plant, samples)
    B = plant.B * inputs.scale / states.scale[:, None]
    train_x = states.to_deviation(parts[0].x)
    train_f = parts[0].dxdt / states.scale - inputs.to_deviation(parts[0].u) @ B.T
    x, f = torch.from_numpy(train_x), torch.from_numpy(train_f)
    provenance = Provenance(plant.name, seed, samples.digest(), {}, __version__)

    best: tuple[float, LiftedModel, Grown] | None = None
    finished = 0
    threads = torch.get_num_threads()
    # one thread: the sums keep their order, and the same seed gives the same bits
    torch.set_num_threads(1)
    try:
        for start in range(starts):
            monitor = None if progress is None else partial(progress, start)
            grown = grow(x, f, recipe, seed + start, monitor)
            model = _assemble(grown, B, states, inputs, plant.time_unit,
                              replace(provenance, seed=seed + start))
            try:
                rw = _validated_rw(grown, recipe, model, parts[1])
            except ValueError:
                # its coordinates collapsed or miss a state: it loses, unless every start does
                if best is None and start == starts - 1:
                    raise
                continue
            finally:
                finished += 1
            if best is None or rw < best[0]:
                best = (rw, model, grown)
    except KeyboardInterrupt:
        if best is None:
            raise
    finally:
        torch.set_num_threads(threads)
    assert best is not None
    _, model, grown = best
    figures = _judge(model, parts[2])
    metrics = {'rw': figures.rw, 'rx': figures.rx, 'cond': figures.cond}
    model = replace(model, provenance=replace(model.provenance, metrics=metrics))
    return Trained(model, figures, grown.status.value, finished)


def _validated_rw(grown: Grown, recipe: Recipe, model: LiftedModel, samples: Samples) -> float:
    """
    Return the rw by which starts are compared.

    :raises ValueError: when the start is no candidate, whatever its rw: rw alone does not see a
        state that the lift has lost.
    """
    if grown.layout.n_z < recipe.n_z and grown.status is not Status.INTERRUPTED:
        raise ValueError(f'training ended at n_z = {grown.layout.n_z}: {grown.status.value}')
    figures = _judge(model, samples)
    if not figures.rx < _MAX_RX:
        raise ValueError(f'the lift does not determine how the state moves (rx = {figures.rx:.2g} '
                         f'on validation samples, must be below {_MAX_RX}): use identity '
                         'coordinates, more of them, or samples that move more')
    return figures.rw


def _judge(model: LiftedModel, samples: Samples) -> Fit:
    return fit(model, samples.x, samples.dxdt, samples.u)


def split_by_episode(samples: Samples, seed: int) -> tuple[Samples, Samples, Samples]:
    """
    Split samples into training (three fifths), validation and test by whole episodes.

    :raises ValueError: with fewer than three episodes.
    """
    episodes = np.unique(samples.episode)
    if len(episodes) < 3:
        raise ValueError(f'training needs at least 3 episodes to hold some out, got '
                         f'{len(episodes)}: record more, or cut the record into episodes')
    order = np.random.default_rng(seed).permutation(episodes)
    held = max(1, len(episodes) // 5)
    return (samples.take(order[2 * held:]), samples.take(order[:held]),
            samples.take(order[held:2 * held]))


def _coordinates(plant: Plant, samples: Samples) -> tuple[Coordinates, Coordinates]:
    """Scale by half the range of the samples, from the nominal point; the range is the box."""
    boxes = []
    for names, units, center, values in (
            (plant.state_names, plant.state_units, plant.nominal_state, samples.x),
            (plant.input_names, plant.input_units, plant.nominal_input, samples.u)):
        lower, upper = values.min(axis=0), values.max(axis=0)
        for name, unit, low, high in zip(names, units, lower, upper, strict=True):
            if not low < high:
                raise ValueError(f'{name} never moves from {low} {unit}: excite the plant')
        boxes.append(Coordinates(names, units, center, 0.5 * (upper - lower), lower, upper))
    return boxes[0], boxes[1]


def _assemble(grown: Grown, B: Array, states: Coordinates, inputs: Coordinates, time_unit: str,
              provenance: Provenance) -> LiftedModel:
    """Turn the flat parameter vector into a run-time model."""
    W, b, V, A = (part.numpy() for part in grown.layout.split(grown.theta))
    hidden = ((W, b),) if len(b) else ()
    return LiftedModel(hidden, V, A, B, grown.layout.identity, states, inputs, time_unit,
                       provenance)
