# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The best model of a training that was interrupted, and its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from koopman_ros.learning.report import write_report
from koopman_ros.learning.training_result import TrainingResult
from koopman_ros.model import save


class Interrupted(KeyboardInterrupt):
    """
    A training that was interrupted, by Ctrl-C or a signal.

    :ivar result: the best of the classes learned by then, not accepted; None before the first.
    """

    def __init__(self, result: TrainingResult | None) -> None:
        self.result = result
        super().__init__('' if result is None else (
            f'{"; ".join(result.reasons)}. `result` of this exception has the model, '
            f'{result.model_class}'))


class UnfinishedTraining:
    """
    Keeper of the result so far, also in a file, which survives whatever ends the process.

    :ivar result: the result so far, None before the first class.
    """

    def __init__(self) -> None:
        self.result: TrainingResult | None = None
        self._files: Sequence[Path] = ()

    def keep(self, result: TrainingResult) -> None:
        """Keep a result; write ``<output>.unfinished.safetensors`` and its report."""
        if result.task.output:
            path = Path(result.task.output).with_suffix('.unfinished.safetensors')
            save(result.model, path)
            result = replace(result, model_file=str(path),
                             task=replace(result.task, output=str(path)))
            # pictures take seconds
            self._files = path, *write_report(result, pictures=False)
        self.result = result

    def discard(self) -> None:
        """Remove the files: the training has ended."""
        for path in self._files:
            path.unlink(missing_ok=True)
