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

"""Progress of a training: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType

from tqdm import tqdm

_LINE_PERIOD = 5.0  # s between plain lines


class TrainingProgress:
    """
    Show the steps of a training; give it to :func:`koopman_ros.lifting.training.train`.

    :param label: what is trained.
    """

    def __init__(self, label: str) -> None:
        self._label = label
        self._bar = tqdm(desc=label, unit='step', disable=not sys.stderr.isatty())
        self._last_line = time.monotonic()

    def __call__(self, start: int, n_z: int, iteration: int, cost: float) -> bool:
        """Take note of a step and go on; `cost` is half the mean square of the residuals."""
        rms = math.sqrt(2.0 * cost)
        if not self._bar.disable:
            self._bar.set_postfix_str(f'start {start + 1}, n_z {n_z}, residual {rms:.2e}',
                                      refresh=False)
            self._bar.update()
        elif time.monotonic() - self._last_line > _LINE_PERIOD:
            self._last_line = time.monotonic()
            print(f'{self._label}: start {start + 1}, n_z {n_z}, step {iteration}, '
                  f'residual {rms:.2e}', file=sys.stderr, flush=True)
        return False

    def __enter__(self) -> TrainingProgress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._bar.close()
