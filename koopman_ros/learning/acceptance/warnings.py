# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Warnings about a record and its drift, for a model that may be accepted all the same."""

from collections.abc import Mapping, Sequence

import numpy as np

from koopman_ros.core.arrays import Array
from koopman_ros.core.units import Display, display_unit
from koopman_ros.learning.acceptance.settings import DEFAULTS, Thresholds
from koopman_ros.learning.causes import likely_causes
from koopman_ros.learning.ensemble import disagreement, inconsistency
from koopman_ros.learning.identification import Identified
from koopman_ros.model import Coordinates, LiftedModel


def record_warnings(found: Identified, model: LiftedModel, error: Array, autocorrelation: Array,
                    settings: Thresholds) -> tuple[str, ...]:
    """Say where the best drift errs by more than white noise explains."""
    warnings = [*found.warnings, *filter(None, [disagreement(found), inconsistency(found)])]
    count = sum(len(episode) for episode in found.held_out)
    measured = len(model.states) - found.hidden
    for i, (name, unit) in enumerate(zip(model.states.names[:measured], model.states.units,
                                         strict=False)):
        noticeable, r = settings.noticeable * found.drift.box.states.scale[i], autocorrelation[i]
        if error[i] > noticeable and r > max(settings.coloured, settings.sigmas / np.sqrt(count)):
            warnings.append(
                f'the noise of {name} is coloured (autocorrelation {r:.2f} from sample to sample '
                'in the residuals of the best drift), because of a filter before the recording or '
                'an unmeasured quantity. Successive samples repeat it: the record counts as '
                f'{100.0 * (1.0 - r) / (1.0 + r):.0f} % of its samples with independent noise. '
                'Record longer, or without the filter')
        noise = np.fmin(found.noise[i], error[i])
        excess = float(np.sqrt(max(0.0, error[i] ** 2 - noise ** 2)))
        # the mean square of `count` white errors strays by this share
        chance = noise * (settings.sigmas * np.sqrt(2.0 / count)) ** 0.5
        if excess > max(chance, noticeable):
            warnings.append(
                f'the best drift predicts {name} with an error of {error[i]:.3g} {unit}, of which '
                f'{excess:.3g} {unit} is not noise ({noise:.3g} {unit} from sample to sample): '
                + _remedy(found, i))
    return tuple(warnings)


def _remedy(found: Identified, i: int) -> str:
    """Name the parameters to try for a measured state, likeliest first."""
    causes = likely_causes(found, i)
    if not causes:
        states = 'set unmeasured_states, or ' * ('unmeasured_states' not in found.searched)
        return f'the inputs do not explain it: {states}record a disturbance as another input'
    return 'set ' + ', or '.join(
        f'{name} (explains {100.0 * share:.0f} % of its square)' for share, name in causes)


def uncovered_setpoints(states: Coordinates, targets: Mapping[str, Sequence[float]],
                        settings: Thresholds = DEFAULTS) -> tuple[str, ...]:
    """
    Say which set-points that are wanted a trained range leaves out.

    :param targets: lowest and highest set-point of some of the states by name, in their units.
    """
    found = []
    for name, (low, high) in targets.items():
        i = states.names.index(name)
        lower, upper = states.lower[i], states.upper[i]
        if max(lower - low, high - upper) > settings.missing_range * (high - low):
            unit = Display(states.units[i], display_unit(states.units[i]), '.4g')
            found.append(
                f'{name} was trained from {unit.text(lower)} to {unit.text(upper)}, set-points '
                f'range from {unit.text(low)} to {unit.text(high)}: those outside will be '
                'rejected; record the missing range, or narrow setpoint_min and setpoint_max')
    return tuple(found)
