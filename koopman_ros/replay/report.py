# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay's report: for a reader, and for a program."""

from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.replay.comparison import Comparison, ReplayedBag
from koopman_ros.reports import write_figures, write_page


def write_report(folder: Path, bags: list[ReplayedBag], pictures: list[str], new_model: str
                 ) -> None:
    """
    Write report.md and summary.json.

    :param folder: where to.
    :param bags: what was replayed.
    :param pictures: file name of each bag's picture.
    :param new_model: name of the new model, or empty.
    """
    summary = {
        'new_model': new_model or None,
        'tolerance_K': bags[0].tolerance,
        'reproduced': all(reproduced(bag) for bag in bags),
        'bags': [_figures(bag) for bag in bags],
    }
    write_figures(folder / 'summary.json', summary)
    sections = [_about(new_model)]
    for bag, picture in zip(bags, pictures, strict=True):
        sections += [f'## {bag.path}', '\n'.join(_section(bag)), f'![commands]({picture})']
    write_page(folder / 'report.md', 'Replay', sections, ('numpy', 'scipy'))


def reproduced(bag: ReplayedBag) -> bool:
    """Tell whether the recorded commands are those of the replay, within the tolerance."""
    return bag.check.compared > 0 and not np.any(bag.check.beyond)


def verdict(bag: ReplayedBag) -> str:
    """Say in one sentence how the replay did."""
    check = bag.check
    if not check.compared:
        return ('nothing is compared: the records hold no command' if not bag.found.samples else
                'nothing is compared: no snapshot of the controller comes before a command')
    if check.identical == check.compared:
        return f'all {check.compared} recorded commands are reproduced bit for bit'
    beyond = int(np.count_nonzero(check.beyond))
    return (f'{check.identical} of {check.compared} recorded commands are reproduced bit for bit, '
            f'{beyond} differ by more than {check.tolerance:g} K; {_worst(bag, check)}')


def _worst(bag: ReplayedBag, comparison: Comparison) -> str:
    worst = comparison.worst
    if worst is None:
        return 'none differs'
    return (f'the largest difference is {_largest(comparison.difference[worst]):+.3g} K, at '
            f'{bag.seconds[worst]:.3f} s (stamp {bag.stamps_ns[worst] / 1e9:.3f} s)')


def _largest(difference: np.ndarray) -> float:
    return float(difference[np.nanargmax(np.abs(difference))])


def _about(new_model: str) -> str:
    text = ('What the controller recorded of itself went through the control step again, with the '
            'models and the parameters that the records name. Times count from the first command '
            'of a bag.')
    if new_model:
        text += (f'\n\nThe commands of `{new_model}` answer the same recorded measurements under '
                 'the set-points that were tracked, with the recorded parameters but for those '
                 'given. They are compared with what was commanded then, one by one: not a closed '
                 'loop, in which the measurements themselves would have become others.')
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
                     f'recorded ones by more than {bag.tolerance:g} K; {_worst(bag, bag.new)}.')
    for count, words in (
            (bag.outside, 'times the tracked set-point is outside the range that the new model '
                          'was trained for, which would have refused it'),
            (len(found.samples) - bag.check.compared, 'commands are not compared, because no '
                                                      'snapshot of the controller precedes them'),
            (found.runs - 1, 'times the controller was started again, or another one recorded'),
            (found.refused, 'requests are refused'),
            (len(found.samples) - bag.measurements, 'commands were given because no measurement '
                                                    'came'),
            (bag.unexplained, 'commands on the topic are in no record')):
        if count > 0:
            lines.append(f'- {count} {words}.')
    lines += [f'- Records {lost.first} to {lost.last} of run {lost.run} are missing.'
              for lost in found.lost]
    if not bag.complete:
        lines.append('- The bag was not closed or is damaged: this is the part that is whole.')
    return lines


def _figures(bag: ReplayedBag) -> dict[str, Any]:
    found = bag.found
    figures: dict[str, Any] = {
        'bag': bag.path,
        'measurements': bag.measurements,
        'reproduced': reproduced(bag),
        'recorded_model': _comparison(bag, bag.check),
        'not_compared': len(found.samples) - bag.check.compared,
        'commands_without_record': bag.unexplained,
        'commands_in_silence': len(found.samples) - bag.measurements,
        'refused_requests': found.refused,
        'began_before_bag': found.begins_late > 0,
        'lost_records': [[lost.run, lost.first, lost.last] for lost in found.lost],
        'runs': found.runs,
        'models': found.models,
        'complete': bag.complete,
    }
    if bag.new is not None:
        figures['new_model'] = _comparison(bag, bag.new)
    return figures


def _comparison(bag: ReplayedBag, comparison: Comparison) -> dict[str, Any]:
    worst = comparison.worst
    return {
        'compared': comparison.compared,
        'identical': comparison.identical,
        'beyond_tolerance': int(np.count_nonzero(comparison.beyond)),
        'largest_difference_K': 0.0 if worst is None else _largest(comparison.difference[worst]),
        'largest_at_s': None if worst is None else float(bag.seconds[worst]),
        'largest_at_stamp_ns': None if worst is None else int(bag.stamps_ns[worst]),
    }
