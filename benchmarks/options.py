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

"""What the user asks of a part of the benchmark."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any


class Extent(Enum):
    """How much is measured."""

    QUICK = 'quick'
    DEFAULT = 'default'
    FULL = 'full'


@dataclass(frozen=True)
class Options:
    """
    What a part is called with.

    :param output: folder for pictures.
    :param extent: how much is measured.
    :param limit: time limit of one solver in one case, s; None for that of the extent.
    :param save: takes the figures so far, so that an interrupt keeps them.
    """

    output: Path
    extent: Extent
    limit: float | None
    save: Callable[[dict[str, Any]], None]
