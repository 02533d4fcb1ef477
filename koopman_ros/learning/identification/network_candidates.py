# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Candidates of drifts that are linear but for a small network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
from dataclasses import dataclass
import time

from koopman_ros.core.datasets import Array
from koopman_ros.execution import Backend, Notify
from koopman_ros.learning.identification.drift import DriftModel, Segments
from koopman_ros.learning.identification.network_drift import NetworkDrift
from koopman_ros.learning.identification.output_error import fitted_by_simulation, Refined
from koopman_ros.learning.identification.structure_candidates import (
    candidate_of,
    Choice,
    StructureCandidate,
)

UNITS = (3, 8)  # hidden units of the networks that are tried
STARTS = 4  # of each network, of which the best is taken
_RIDGE = 1e-4  # weight of its squared parameters relative to the mean squared error


def network_starts(seed: int) -> dict[str, tuple[int, int]]:
    """Return the hidden units and the seeds of all networks by name."""
    return {f'network of {units} units, start {start + 1}': (units, STARTS * seed + start)
            for units in UNITS for start in range(STARTS)}


@dataclass(frozen=True)
class Shared:
    """The common data of all networks."""

    linear: StructureCandidate  #: to which they are added
    data: tuple[Segments, Array]  #: pieces that are simulated, and where they start
    learn_input_matrix: bool
    budget: float  #: of each, in s of processor time

    def allowed(self, network: NetworkDrift) -> bool:
        """Return whether a network diverges far from the data only where the plant does."""
        return network.bounded or self.linear.model.drift.growth_rate >= 0.0

    def candidate(self, network: Refined[NetworkDrift]) -> StructureCandidate | None:
        """Return the candidate of a network."""
        return candidate_of(network, self.linear.start, self.data[0], self.linear.record)


def add_networks(choice: Choice, shared: Shared, items: Mapping[str, tuple[int, int]],
                 stage: Callable[[str], Callable[..., bool]], backend: Backend) -> None:
    """Add the best network of each size, of several starts."""
    monitors = dict[str, Callable[..., bool]]()

    def watch(name: str, _: object) -> bool:
        if name not in monitors:
            monitors[name] = stage(name)
        return monitors[name]() and False

    for units in dict.fromkeys(units for units, _ in items.values()):
        own = {name: item for name, item in items.items() if item[0] == units}
        with contextlib.closing(backend.run(_network, own, shared=shared, watch=watch)) as results:
            fitted = [found for _, found in results if found is not None]
        best = min(fitted, key=lambda one: one.cost, default=None)
        choice.gains(None if best is None else shared.candidate(best), f'network of {units} units')


def best_units(choice: Choice) -> int | None:
    """Return the hidden units of the best network; None where there is none."""
    networks = [(one.score.cost, len(one.model.b1)) for one in choice.candidates
                if isinstance(one.model, NetworkDrift)]
    return min(networks)[1] if networks else None


def _network(shared: Shared, item: tuple[int, int], notify: Notify
             ) -> Refined[NetworkDrift] | None:
    """Return a network that fits the record; None where it may diverge."""
    end = time.process_time() + shared.budget

    def monitor(*_: object) -> bool:
        notify(None)
        return time.process_time() > end

    monitor()
    (units, seed), drift = item, shared.linear.model.drift
    assert isinstance(drift, DriftModel)
    found = fitted_by_simulation(
        NetworkDrift.added_to(drift, units, seed, ridge=_RIDGE,
                            learn_input_matrix=shared.learn_input_matrix),
        *shared.data, monitor=monitor)
    return found if shared.allowed(found.model) else None
