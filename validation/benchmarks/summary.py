# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The file in which the parts of the benchmark leave their figures side by side."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from koopman_ros.reports import write_figures


class Summary:
    """
    A JSON file with one key a part; writing one part keeps the others.

    :param path: the file, which need not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[str, Any]:
        """Return what the parts have left, nothing where there is no file."""
        if not self.path.exists():
            return {}
        loaded = json.loads(self.path.read_text())
        if not isinstance(loaded, dict):
            raise ValueError(f'{self.path} does not hold the figures of a benchmark: move it away')
        return loaded

    def write(self, part: str, figures: dict[str, Any]) -> None:
        """Put a part's figures in the place of its old ones."""
        write_figures(self.path, {**self.read(), part: figures})
