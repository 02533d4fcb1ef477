# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""From samples to the scaled problem that a lift is learned from, and from its solution back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from koopman_ros.core.datasets import Array, DriftSamples, PlantDescription
from koopman_ros.learning.lift.incremental import IncrementalTraining, TrainedLift
from koopman_ros.learning.lift.input_model import InputModel
from koopman_ros.learning.lift.prestabilization import PrestabilizedFrame
from koopman_ros.learning.lift.residuals import deviations, ScaledSamples
from koopman_ros.model import Box, Coordinates, LiftedModel, NetworkObservables


@dataclass(frozen=True)
class Scaling:
    """Scaling of samples for training, and of its result back."""

    box: Box  #: names and scaling of states and inputs
    inputs: InputModel  #: the known part of B
    frame: PrestabilizedFrame | None  #: in which the lift is learned; None for that of the samples
    #: root mean square of the scaled rates, by which time is scaled, in 1/time unit
    pace: float

    @staticmethod
    def of(plant: PlantDescription, box: Box, samples: DriftSamples,
           pre_feedback: float | None) -> Scaling:
        """
        Choose it by some samples.

        :param pre_feedback: as in :class:`IncrementalTraining`.
        """
        inputs = InputModel.of(plant, box, samples.x)
        plain = _plain(box, inputs, samples)
        frame = None if pre_feedback is None else PrestabilizedFrame.of(inputs, *plain,
                                                                        pre_feedback)
        # rates of order one make the residuals of the dynamics comparable with the others
        rate = frame.enter(*plain)[1] if frame else deviations(box, samples)[1]
        return Scaling(box, inputs, frame, float(np.sqrt(np.mean(rate ** 2))) or 1.0)

    def data(self, samples: DriftSamples, device: str) -> ScaledSamples:
        """
        Scale samples, onto a device as torch names it.

        :raises ValueError: for an unavailable device.
        """
        plain = _plain(self.box, self.inputs, samples)
        x, f, regressors = self.frame.enter(*plain) if self.frame else plain
        arrays = (x, f / self.pace, *([] if regressors is None else [regressors]))
        place = checked_device(device)
        return ScaledSamples(*(torch.from_numpy(a).to(place) for a in arrays))

    def planted(self, recipe: IncrementalTraining, begin: LiftedModel,
                data: ScaledSamples) -> TrainedLift:
        """
        Return the lift of another plant of the same signals as one of these samples.

        Its hidden units are the same functions of the states in their units.

        :param data: the samples, scaled.
        :raises ValueError: for a lift that the recipe would not make, of other signals, or with a
            coordinate that is constant on the samples.
        """
        own, network = self.box.states, begin.observables
        for kind, its, ours in (('states', begin.states, own),
                                ('inputs', begin.inputs, self.box.inputs)):
            if (its.names, its.units) != (ours.names, ours.units):
                raise ValueError(f'the initial lift has the {kind} {_listed(its)}, but the plant '
                                 f'has {_listed(ours)}: use the lift of a plant of the same kind')
        if not isinstance(network, NetworkObservables) or not len(network.V) or (
                network.identity != recipe.identity):
            raise ValueError(
                'the initial lift is of another class: start from one with '
                f'{"" if recipe.identity else "no "}identity coordinates, and others of a network')
        # deviations there are `stretch` times those here and `shift`
        stretch = own.scale / begin.states.scale
        shift = (own.center - begin.states.center) / begin.states.scale
        W, b = network.W * stretch, network.b + network.W @ shift
        if self.frame:
            W = W @ np.linalg.inv(self.frame.T)
        # units of the read-out alone have no part in z
        used = np.any(network.V != 0.0, axis=0)
        return recipe.planted(data, *(data.x.new_tensor(np.ascontiguousarray(a)) for a in (
            W[used], b[used], network.V[:, used])))

    def model(self, grown: TrainedLift, **about: Any) -> LiftedModel:
        """Return the trained model in units; `about` are further fields of the model."""
        parts = grown.layout.split(grown.theta.cpu())
        A = self.pace * parts.A.numpy()
        B = None if parts.B is None else self.pace * parts.B.numpy()
        alone = grown.drift_alone
        observables = NetworkObservables(
            parts.W.numpy(), parts.b.numpy(), parts.V.numpy()[:0 if alone else None],
            alone or grown.layout.identity)
        if self.frame:
            observables, A, B = self.frame.leave(observables, A, B)
        constant, terms = self.inputs.matrix(B)
        return LiftedModel(observables, A, constant, self.box.states, self.box.inputs,
                           self.box.time_unit, input_terms=terms,
                           pre_feedback=self.frame.K if self.frame else None, **about)


def _listed(signals: Coordinates) -> str:
    return ', '.join(f'{name} [{unit}]' for name, unit in zip(
        signals.names, signals.units, strict=True)) or 'none'


def _plain(box: Box, inputs: InputModel, samples: DriftSamples) -> tuple[Array, Array,
                                                                         Array | None]:
    """Return states, rates less the known effect of inputs, and regressors of the rest."""
    x, rate, u = deviations(box, samples)
    return x, *inputs.apart(x, rate, u)


def checked_device(name: str) -> torch.device:
    """Return a device of torch's; ValueError, saying why, for an unavailable one."""
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        found = f'{torch.cuda.device_count()} GPU(s)' if torch.cuda.is_available() else 'no GPU'
        raise ValueError(
            f'device is {name!r}, but torch {torch.__version__} finds {found} on this machine '
            f'({str(error).splitlines()[0]}): use cpu, or install a matching driver and '
            'torch') from error
    return device
