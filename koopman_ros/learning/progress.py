# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Progress of a training: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType

from tqdm import tqdm

from koopman_ros.learning import Progress

_LINE_PERIOD = 5.0  # s between plain lines


class TrainingProgress:
    """Show the starts of a training; give it to :func:`koopman_ros.learning.train`."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._bar = tqdm(desc=label, unit='start', disable=not sys.stderr.isatty())
        self._last_line = time.monotonic()

    def __call__(self, now: Progress) -> bool:
        """Take note of a step and go on."""
        text = f'n_z {now.n_z}'
        if not math.isnan(now.rw):
            text += f', rw {now.rw:.1e}'
        if now.iteration:
            text += f', step {now.iteration}, residual {now.residual:.1e}'
        if not self._bar.disable:
            self._bar.total = now.total
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update(now.finished - self._bar.n)
        elif time.monotonic() - self._last_line > _LINE_PERIOD:
            self._last_line = time.monotonic()
            print(f'{self._label}: start {now.finished + 1} of {now.total}, {text}',
                  file=sys.stderr, flush=True)
        return False

    def __enter__(self) -> TrainingProgress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._bar.close()
