# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What an experiment hands back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from koopman_ros.lifting import LiftedModel

# Figures by name; None where there is none, e.g. after a divergence.
Metrics: TypeAlias = dict[str, float | bool | dict[str, 'float | bool | None'] | None]
# Models by name, for the figures.
Models: TypeAlias = Mapping[str, LiftedModel]
