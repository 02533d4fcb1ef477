# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The methods that identification chooses from: a row each."""

from collections.abc import Callable, Mapping, Sequence

from koopman_ros.identification.drift import DriftModel
from koopman_ros.identification.total_variation import total_variation
from koopman_ros.identification.weak_form import weak_form
from koopman_ros.lifting import Box
from koopman_ros.plant_data import Array, Episode

# Fits a drift to episodes: their box, the degree, B (n_x, n_u) scaled or None to learn it, and a
# rough B: that of the method before, None for the first where B is to be learned. A method that
# raises ValueError, as on short episodes, is left out.
Method = Callable[[Sequence[Episode], Box, int, Array | None, Array | None],
                  DriftModel]


def weak_forms(*windows: int) -> dict[str, Method]:
    """Return the weak form with windows of so many samples, by name."""
    def method(window: int) -> Method:
        return lambda episodes, box, degree, B, _: weak_form(episodes, box, degree, B, window)

    return {f'weak form, {window} samples': method(window) for window in windows}


# The widest window knows B best, and is what total variation goes by.
METHODS: Mapping[str, Method] = {
    **weak_forms(10, 20, 40, 80),
    'total variation': total_variation,
}
