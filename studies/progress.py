# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Progress of a training: a bar on a terminal, plain lines elsewhere."""

from collections.abc import Iterator
import contextlib
import math
import sys
import time

from tqdm import tqdm

from koopman_ros.learning.lift.multistart import MultistartProgress, Watch

_LINE_PERIOD = 5.0  # s between plain lines


@contextlib.contextmanager
def training_progress(label: str) -> Iterator[Watch]:
    """Show the starts of a training; the yielded function is `watch` of `learning.train`."""
    last_line = time.monotonic()

    def watch(now: MultistartProgress) -> bool:
        nonlocal last_line
        text = f'{now.name}, ' * bool(now.name) + f'n_z {now.n_z}'
        if not math.isnan(now.rw):
            text += f', rw {now.rw:.1e}'
        if now.iteration:
            text += f', step {now.iteration}, residual {now.residual:.1e}'
        if not bar.disable:
            bar.total = now.total
            bar.set_postfix_str(text, refresh=False)
            bar.update(now.finished - bar.n)
        elif time.monotonic() - last_line > _LINE_PERIOD:
            last_line = time.monotonic()
            print(f'{label}: start {min(now.finished + 1, now.total)} of {now.total}, {text}',
                  file=sys.stderr, flush=True)
        return False

    with tqdm(desc=label, unit='start', disable=not sys.stderr.isatty()) as bar:
        yield watch
