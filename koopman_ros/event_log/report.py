# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Recorded and replayed commands side by side, in numbers and as a report."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from koopman_ros.core.arrays import Array
from koopman_ros.core.plots import write_figures, write_page
from koopman_ros.event_log.loop import Replay
from koopman_ros.model import Coordinates


@dataclass(frozen=True)
class CommandComparison:
    """How commands differ from the recorded ones."""

    #: (n, n_u) command minus recorded command in input units; NaN where there is none to be
    #: compared
    difference: Array
    identical: int  #: number of commands that are bit-identical
    tolerance: float  #: in input units

    @property
    def compared(self) -> int:
        """The number of commands that are compared."""
        return int(np.count_nonzero(np.isfinite(self.difference).all(axis=1)))

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """(n,) where the difference exceeds the tolerance."""
        return np.any(np.abs(self.difference) > self.tolerance, axis=1)

    @property
    def worst(self) -> int | None:
        """The place of the largest difference, or None when nothing differs."""
        if not np.nanmax(np.abs(self.difference), initial=0.0) > 0.0:
            return None
        return int(np.nanargmax(np.abs(self.difference))) // self.difference.shape[1]


@dataclass(frozen=True)
class ReplayedBag:
    """A bag with its replay."""

    path: str  #: of the bag
    complete: bool  #: whether its recorder closed it
    found: Replay  #: result of the replay
    tolerance: float  #: difference in input units from which on a command is counted
    new_range: Coordinates | None  #: of the new model's training, or None without one
    stamps_ns: NDArray[np.int64]  #: (n,) stamps of the commands
    measured: Array  #: (n, n_y) measured; NaN in silence
    setpoint: Array  #: (n, n_c) tracked; NaN for none
    recorded: Array  #: (n, n_u) recorded commands
    commands: Array  #: (n, n_u) commands of the replay; NaN where it has no state
    new_commands: Array  #: (n, n_u) commands of the new model; NaN where it has no state
    check: CommandComparison  #: of the replay with the record
    new: CommandComparison | None  #: of the new model with the record, or None

    @property
    def seconds(self) -> Array:
        """(n,) stamps since the first one in s."""
        return (self.stamps_ns - self.stamps_ns[0]) / 1e9

    @property
    def measurements(self) -> int:
        """The number of measurements answered."""
        return sum(sample.measured is not None for sample in self.found.samples)

    @property
    def outside(self) -> int:
        """At how many commands the new model would have rejected the tracked set-point."""
        controller = self.found.controller
        if self.new_range is None or controller is None:
            return 0
        # by their places, for the new model may have names of its own
        names = controller.model.states.names
        kept = [names.index(name) for name in controller.controlled.names]
        return int(np.count_nonzero(((self.setpoint < self.new_range.lower[kept])
                                     | (self.setpoint > self.new_range.upper[kept])).any(axis=1)))


def compared_bag(path: str, complete: bool, found: Replay, tolerance: float,
                 new_range: Coordinates | None = None) -> ReplayedBag:
    """Compare the commands of a replay with those that a bag holds."""
    def compared(commands: Array) -> CommandComparison:
        same = (commands.view(np.uint64) == recorded.view(np.uint64)).all(axis=1)
        return CommandComparison(commands - recorded, int(np.count_nonzero(same)), tolerance)

    samples = found.samples
    recorded = _rows([sample.recorded for sample in samples])
    commands = _rows([sample.replayed for sample in samples], recorded)
    new_commands = _rows([sample.alternative for sample in samples], recorded)
    return ReplayedBag(
        path, complete, found, tolerance, new_range,
        np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
        _rows([sample.measured for sample in samples]),
        _rows([sample.setpoint for sample in samples]), recorded, commands, new_commands,
        compared(commands), None if new_range is None else compared(new_commands))


def _rows(values: list[Array | None], like: Array | None = None) -> Array:
    """Return (n, m) with NaN for None; m from the first one there is, or as another array has."""
    width = next((len(value) for value in values if value is not None),
                 1 if like is None else like.shape[1])
    return np.array([np.full(width, np.nan) if value is None else value for value in values],
                    dtype=np.float64).reshape(len(values), width)


def write_report(folder: Path, bags: list[ReplayedBag], pictures: list[str], new_model: str
                 ) -> None:
    """Write report.md and summary.json; `new_model` is the new model's name, or empty."""
    write_figures(folder / 'summary.json', {
        'new_model': new_model or None, 'tolerance': bags[0].tolerance,
        'reproduced': all(reproduced(bag) for bag in bags),
        'bags': [_figures(bag) for bag in bags]})
    sections = [_about(new_model)]
    for bag, picture in zip(bags, pictures, strict=True):
        sections += [f'## {bag.path}', '\n'.join(_section(bag)), f'![commands]({picture})']
    write_page(folder / 'report.md', 'Replay', sections, ('numpy', 'scipy'))


def reproduced(bag: ReplayedBag) -> bool:
    """Whether the recorded commands are those of the replay, within the tolerance."""
    return bag.check.compared > 0 and not bag.check.beyond.any()


def verdict(bag: ReplayedBag) -> str:
    """Return the result of the replay in one sentence."""
    check = bag.check
    if not check.compared:
        return ('nothing to compare: the records contain no command' if not bag.found.samples else
                'nothing to compare: no snapshot of the controller precedes a command')
    if check.identical == check.compared:
        return f'all {check.compared} recorded commands are reproduced exactly'
    beyond = int(np.count_nonzero(check.beyond))
    return (f'{check.identical} of {check.compared} recorded commands are reproduced exactly, '
            f'{beyond} differ by more than {check.tolerance:g}; {_worst(bag, check)}')


def _worst(bag: ReplayedBag, comparison: CommandComparison) -> str:
    worst = comparison.worst
    if worst is None:
        return 'none differs'
    return (f'the largest difference is {_largest(comparison.difference[worst]):+.3g}, at '
            f'{bag.seconds[worst]:.3f} s (stamp {bag.stamps_ns[worst] / 1e9:.3f} s)')


def _largest(difference: np.ndarray) -> float:
    return float(difference[np.nanargmax(np.abs(difference))])


def _about(new_model: str) -> str:
    text = ('The control step was re-run on the events that the controller recorded, with the '
            'recorded models and parameters. Times are relative to the first command of a bag.')
    if new_model:
        text += (f'\n\nThe commands of `{new_model}` are computed for the same recorded '
                 'measurements and active set-points, with the recorded parameters except those '
                 'given. They are compared with the recorded commands one by one. This is not a '
                 'closed loop: with the new model the measurements would have been different.')
    return text


def _section(bag: ReplayedBag) -> list[str]:
    found = bag.found
    minutes = float(np.ptp(bag.seconds)) / 60.0 if found.samples else 0.0
    lines = [f'- {bag.measurements} measurements over {minutes:.2f} min.',
             f'- Recorded commands: {verdict(bag)}.',
             f'- Models: {", ".join(found.models) or "unknown"}.']
    if bag.new is not None:
        beyond = int(np.count_nonzero(bag.new.beyond))
        lines.append(f'- New model: {beyond} of {bag.new.compared} commands differ from the '
                     f'recorded ones by more than {bag.tolerance:g}; {_worst(bag, bag.new)}.')
    for count, words in (
            (bag.outside, 'times the tracked set-point is outside the range that the new model '
                          'was trained for, which would have rejected it'),
            (len(found.samples) - bag.check.compared, 'commands are not compared, because no '
                                                      'snapshot of the controller precedes them'),
            (found.runs - 1, 'restarts of the controller, or other controllers in the bag'),
            (found.rejected, 'requests were rejected'),
            (len(found.samples) - bag.measurements, 'commands were given without a measurement')):
        if count > 0:
            lines.append(f'- {count} {words}.')
    lines += [f'- Records {lost.first} to {lost.last} of run {lost.run} are missing.'
              for lost in found.lost]
    if not bag.complete:
        lines.append('- The bag was not closed or is damaged: only the intact part was replayed.')
    return lines


def _figures(bag: ReplayedBag) -> dict[str, Any]:
    found = bag.found
    figures: dict[str, Any] = {
        'bag': bag.path, 'measurements': bag.measurements, 'reproduced': reproduced(bag),
        'recorded_model': _comparison(bag, bag.check),
        'not_compared': len(found.samples) - bag.check.compared,
        'commands_in_silence': len(found.samples) - bag.measurements,
        'rejected_requests': found.rejected,
        'began_before_bag': found.begins_late > 0,
        'lost_records': [[lost.run, lost.first, lost.last] for lost in found.lost],
        'runs': found.runs, 'models': found.models, 'complete': bag.complete,
    }
    if bag.new is not None:
        figures['new_model'] = _comparison(bag, bag.new)
    return figures


def _comparison(bag: ReplayedBag, comparison: CommandComparison) -> dict[str, Any]:
    worst = comparison.worst
    return {
        'compared': comparison.compared, 'identical': comparison.identical,
        'beyond_tolerance': int(np.count_nonzero(comparison.beyond)),
        'largest_difference': 0.0 if worst is None else _largest(comparison.difference[worst]),
        'largest_at_s': None if worst is None else float(bag.seconds[worst]),
        'largest_at_stamp_ns': None if worst is None else int(bag.stamps_ns[worst]),
    }
