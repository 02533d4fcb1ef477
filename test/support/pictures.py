# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of pictures that are written."""

from collections.abc import Iterator
import contextlib
from pathlib import Path

from matplotlib.figure import Figure
import pytest


@contextlib.contextmanager
def drawn_figures() -> Iterator[dict[str, Figure]]:
    """Yield a mapping that gets the figure of each picture that is written, by file name."""
    figures: dict[str, Figure] = {}
    write = Figure.savefig

    def savefig(figure: Figure, path: Path, **options: object) -> None:
        figures[Path(path).name] = figure
        write(figure, path, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, 'savefig', savefig)
        yield figures


def title(figure: Figure) -> str:
    """Return the title of a figure."""
    return figure.texts[0].get_text()
