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

"""What an experiment hands back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from koopman_ros.lifting import LiftedModel

# Figures by name; None where there is none, e.g. after a divergence.
Metrics: TypeAlias = dict[str, float | bool | dict[str, 'float | bool | None'] | None]
# Models by name, for the figures.
Models: TypeAlias = Mapping[str, LiftedModel]
