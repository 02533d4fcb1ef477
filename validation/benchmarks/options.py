# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the user asks of a part of the benchmark, and what all parts say."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
import sys
from typing import Any

# With so few numbers other threads only wait and spin.
ONE_THREAD = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}


class Extent(Enum):
    """How much is measured."""

    QUICK = 'quick'
    DEFAULT = 'default'
    FULL = 'full'


@dataclass(frozen=True)
class Options:
    """What a part is called with."""

    output: Path  #: folder for pictures
    extent: Extent  #: how much is measured
    limit: float | None  #: time limit of one solver in one case, s; None for that of the extent
    #: takes the figures so far, so that an interrupt keeps them
    save: Callable[[dict[str, Any]], None]


def tell(label: str) -> None:
    """Tell what begins."""
    print(label, file=sys.stderr, flush=True)


def say(lines: Iterable[str]) -> None:
    """Print a result."""
    print('\n'.join(lines) + '\n', flush=True)
