# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Progress of a training over its stages."""

from __future__ import annotations

from collections.abc import Callable

from koopman_ros.learning.identification import Stopped
from koopman_ros.learning.lift.multistart import MultistartProgress

# Shares of the whole at which reading, estimating, learning and judging begin and end.
_STAGES = {'read': (0.0, 0.05), 'estimate': (0.05, 0.35), 'learn': (0.35, 0.9),
           'decide': (0.9, 1.0)}
# Shares of the last stage at which the closed loops, and further ones, end.
JUDGED, WRITING = 0.8, 0.9

# Called with the completed share in [0, 1] and the current step; True asks to stop.
OnProgress = Callable[[float, str], bool]


class PipelineProgress:
    """Reports how far a training is; raises Stopped when it is asked to end."""

    def __init__(self, on_progress: OnProgress) -> None:
        self._on_progress, self.learned, self._read = on_progress, 0.0, 0
        self._share = 0.0

    def __call__(self, stage: str, share: float, text: str) -> None:
        """Report the share of a stage that is done."""
        begin, end = _STAGES[stage]
        # a search that is extended has more to do than was counted; what is done remains done
        self._share = max(self._share, begin + share * (end - begin))
        if self._on_progress(self._share, text):
            raise Stopped

    def reading(self, total: int) -> Callable[[int], None]:
        """Return a tick that is given the samples that were read, of a total."""
        def tick(samples: int) -> None:
            self._read += samples
            self('read', min(1.0, self._read / total), 'reading bags')

        return tick

    def estimating(self, done: int, total: int, text: str) -> bool:
        """Report the steps of the estimation that are done."""
        self('estimate', done / total, f'estimating: {text}')
        return False

    def learning(self, now: MultistartProgress) -> bool:
        """Report the starts of a class of models."""
        self.learned = now.finished / now.total
        self('learn', self.learned, f'learning: {now.name}, {now.text}')
        return False

    def judging_further(self, share: float) -> bool:
        """Report the closed loops on plausible plants."""
        self('decide', JUDGED + share * (WRITING - JUDGED), 'judging: further closed loops')
        return False

    def judging(self, name: str, share: float) -> bool:
        """Report the closed loops of a class of models."""
        # the closed loops of the last class come after all starts
        done = ('decide', JUDGED * share) if self.learned == 1.0 else ('learn', self.learned)
        self(*done, f'judging: {name}')
        return False
