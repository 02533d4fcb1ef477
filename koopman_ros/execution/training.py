# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A training in a child process: start, progress, outcome, cancel; without ROS and torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import json
import queue
import signal
import sys
import time
from typing import Any

from koopman_ros.core.progress import show_bar
from koopman_ros.core.units import difference_text
from koopman_ros.execution.job import Job

_LINE_PERIOD = 5.0  # s between plain lines of progress


@dataclass(frozen=True)
class JobState:
    """Where a retraining stands, with the figures of a lift that was judged."""

    share: float = 0.0  #: done, in [0, 1]
    text: str = 'starting'  #: the present stage, or the result
    ended: bool = False  #: whether it has ended
    summary: Mapping[str, Any] | None = None
    cancelled: bool = False  #: whether it has ended because that was requested

    @property
    def accepted(self) -> bool:
        """Whether there is a new lift that may be used."""
        return bool(self.summary and self.summary['accepted'])

    @property
    def rejected(self) -> bool:
        """Whether a lift was learned or tried and does not suffice."""
        return bool(self.summary and not self.summary['accepted'])


class TrainingProgress:
    """
    How far a training is: a bar on a terminal, else a line every five seconds.

    :param say: prints such a line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._begin = self._last_line = time.monotonic()

    def show(self, state: JobState) -> None:
        """Show a state of the training."""
        text = f'{self._left(state.share)}{state.text}'
        if sys.stderr.isatty():
            show_bar(state.share, *(('', '\n') if state.ended else (text,)))
        elif not state.ended and time.monotonic() - self._last_line > _LINE_PERIOD:
            self._last_line = time.monotonic()
            self._say(f'{100.0 * state.share:.0f} %: {text}')

    def _left(self, share: float) -> str:
        """Return about how long it will still take, by the time that it took so far."""
        spent = time.monotonic() - self._begin
        if spent < _LINE_PERIOD or not 0.0 < share < 1.0:
            return ''
        seconds = spent * (1.0 - share) / share
        return (f'about {seconds:.0f} s left, ' if seconds < 90.0 else
                f'about {seconds / 60.0:.0f} min left, ')


class TrainingJob(Job):
    """A training in a child process, of fields of :class:`koopman_ros.learning.TrainingTask`."""

    def __init__(self, task: Mapping[str, object]) -> None:
        self.state = JobState()
        self._cancelled = False
        super().__init__('koopman_ros.learning.training_process', task=json.dumps(dict(task)))

    def poll(self) -> JobState:
        """Read the output of the process since the last call, and return its state."""
        try:
            while not self.state.ended:
                line = self.line()
                self.state = self._ended() if line is None else self._parsed(line)
        except queue.Empty:
            pass
        return self.state

    def cancel(self) -> None:
        """Request the end of the process, which keeps the best model so far."""
        self._cancelled = True
        super().cancel()

    def _parsed(self, line: str) -> JobState:
        try:
            message = json.loads(line)
        except ValueError:
            # cut off when the process was killed, or printed by a library
            return self.state
        if 'progress' in message:
            return replace(self.state, share=message['progress'],
                           text=message['text'] or self.state.text)
        if 'summary' in message:
            return JobState(1.0, outcome_text(message['summary']), True, message['summary'])
        if 'stopped' in message:
            return JobState(self.state.share, f'cancelled; {message["stopped"]}', True,
                            cancelled=True)
        return JobState(self.state.share, f'training failed: {message["error"]}', True)

    def _ended(self) -> JobState:
        """Return the state of a process that ended without a last line."""
        code = self.process.wait()
        if self._cancelled:
            # by force it may have ended later
            text = 'cancelled' if code < 0 else 'cancelled; nothing was written'
        elif code < 0:
            name = next((s.name for s in signal.Signals if s == -code), f'signal {-code}')
            remedy = ('the limit is one day of processor time; train on fewer bags'
                      if name == 'SIGXCPU' else
                      'check the free memory, and train again')
            text = f'the training process was killed by {name}: {remedy}'
        else:
            last = self.errors[-1] if self.errors else 'no error message'
            text = f'the training process ended with code {code}: {last}'
            if last.startswith(('ModuleNotFoundError', 'ImportError')):
                text = (f'training needs a package that is not installed ({last}): '
                        'pip install torch cloudpickle joblib tqdm')
        return replace(self.state, text=text, ended=True, cancelled=self._cancelled)


def outcome_text(summary: Mapping[str, Any]) -> str:
    """Return the result of a training in a sentence."""
    if summary['accepted'] is None:
        return (f'the best model so far ({summary["model_class"]}) is kept as '
                f'{summary["model_file"]}: {"; ".join(summary["reasons"])}')
    if not summary['accepted']:
        reasons = '; '.join(summary['reasons'])
        kept = f'; saved as {summary["model_file"]}' if summary['model_file'] else ''
        return f'the new model ({summary["model_class"]}) is rejected: {reasons}{kept}'
    present, statement = (summary.get(key) for key in (
        'heldout_error_of_current_model', 'closed_loop_statement'))
    other, name = (('heldout_error_of_linear_model', 'best linear model') if present is None else (
        'heldout_error_of_current_model', 'current model'))
    units = summary['units']
    return (f'the new model ({summary["model_class"]}) is accepted: its error on held-out data is '
            f'{_errors(summary["heldout_error"], units)}, that of the {name} '
            + ('infinite (diverges)' if None in summary[other].values()
               else _errors(summary[other], units))
            + f'; written to {summary["model_file"]}'
            + (f'. {statement}' if statement else ''))


def _errors(errors: Mapping[str, float | None], units: Mapping[str, str]) -> str:
    return ', '.join(('infinite' if value is None else difference_text(value, units[name]))
                     + (f' in {name}' if len(errors) > 1 else '')
                     for name, value in errors.items())


def class_lines(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return a line for each of several classes that were learned, by name; else nothing."""
    classes = summary.get('classes', {})
    return {} if len(classes) < 2 else {
        name: _class_line(one, summary['units']) for name, one in classes.items()}


def constant_lines(summary: Mapping[str, Any]) -> dict[str, str]:
    """Return a line for each constant that was estimated, by name."""
    return {name: one['text'] for name, one in summary.get('constants', {}).items()}


def _class_line(one: Mapping[str, Any], units: Mapping[str, str]) -> str:
    parts = []
    if 'heldout_error' in one:
        rx, failed, loops = (one[key] for key in (
            'heldout_rx', 'closed_loops_failed', 'closed_loops'))
        parts = [f'drift rx {"infinite" if rx is None else f"{rx:.1e}"}',
                 f'roll-out {_errors(one["heldout_error"], units)}',
                 f'controller fails in {failed} of {loops} simulated closed loops']
    line = 'chosen: ' * one['chosen'] + ', '.join([*parts, f'{one["seconds"]:.1f} s'])
    return '; '.join(filter(None, [line, one['limit'], one['rejection'] and (
        f'rejected: {one["rejection"]}')]))


def scalars(summary: Mapping[str, Any]) -> dict[str, bool | float | str]:
    """Return the figures of a summary one by one, those of a signal under its name."""
    found: dict[str, bool | float | str] = {
        **{f'class {name}': line for name, line in class_lines(summary).items()},
        **{f'constant {name}': line for name, line in constant_lines(summary).items()}}
    for key, value in summary.items():
        if key in ('classes', 'constants'):
            continue
        if isinstance(value, Mapping):
            found |= {f'{key}: {name}': one for name, one in scalars(value).items()}
        elif isinstance(value, (bool, int, float, str)):
            found[key] = value
    return found
