# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where a model comes from: its data, held-out figures and acceptance."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Provenance:
    """
    Origin of a model, its held-out figures and its acceptance.

    :raises ValueError: for a rejection without a reason, or reasons without a verdict.
    """

    plant: str  #: name of the plant it was learned from
    seed: int | None = None  #: seed of the training run, or None for a model that was not trained
    data_digest: str = ''  #: SHA-256 of the training samples, in hexadecimal
    #: held-out figures: ``rw``, ``rx`` and ``cond`` without unit, ``rollout_rmse`` in state units;
    #: from measured data also ``noise`` in state units and ``coverage``, the visited share of the
    #: training box
    metrics: Mapping[str, float] = field(default_factory=dict)
    package_version: str = ''  #: version of koopman_ros that made it
    method: str = ''  #: how derivatives were found; empty where they were given
    #: one of :data:`koopman_ros.model_classes.CLASSES`, or empty where training did not state it
    model_class: str = ''
    accepted: bool | None = None  #: verdict of the acceptance test; None if not tested
    reasons: tuple[str, ...] = ()  #: for the verdict; at least one for a rejection
    closed_loops: str = ''  #: result of simulated closed loops, with its confidence

    def __post_init__(self) -> None:
        if bool(self.reasons) < (self.accepted is False) or bool(self.reasons) > (
                self.accepted is not None):
            raise ValueError(f'accepted = {self.accepted} contradicts the reasons '
                             f'{list(self.reasons)}')

    @property
    def acceptance(self) -> str:
        """The verdict in words, with the reasons."""
        verdict = {True: 'accepted', False: 'rejected', None: 'not tested'}[self.accepted]
        return f'{verdict} ({"; ".join(self.reasons)})' if self.reasons else verdict
