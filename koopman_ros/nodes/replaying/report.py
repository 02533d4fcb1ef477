# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay's report: for a reader, and for a program."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.nodes.replay_parameters import ReplayParameters
from koopman_ros.nodes.replaying.comparison import Comparison, ReplayedBag


def write_report(folder: Path, bags: list[ReplayedBag], pictures: list[str],
                 parameters: ReplayParameters) -> None:
    """
    Write report.md and summary.json.

    :param folder: where to.
    :param bags: what was replayed.
    :param pictures: file name of each bag's picture.
    :param parameters: of the replay.
    """
    summary = {
        'model': parameters.model,
        'new_model': parameters.new_model or None,
        'tolerance_K': parameters.tolerance,
        'reproduced': all(reproduced(bag) for bag in bags),
        'bags': [_figures(bag) for bag in bags],
    }
    (folder / 'summary.json').write_text(json.dumps(summary, indent=2) + '\n', encoding='utf-8')
    lines = ['# Replay', '', _about(parameters), '']
    for bag, picture in zip(bags, pictures, strict=True):
        lines += [f'## {bag.path}', '', *_section(bag, parameters), '', f'![commands]({picture})',
                  '']
    (folder / 'report.md').write_text('\n'.join(lines), encoding='utf-8')


def reproduced(bag: ReplayedBag) -> bool:
    """Tell whether the recorded commands are those of the replay, within the tolerance."""
    return bag.check.compared > 0 and not np.any(bag.check.beyond)


def verdict(bag: ReplayedBag) -> str:
    """Say in one sentence how the replay of the recorded model did."""
    check = bag.check
    if not check.compared:
        return f'nothing is compared: {_why_nothing(bag)}'
    if check.identical == check.compared:
        return f'all {check.compared} recorded commands are reproduced to the bit'
    beyond = int(np.count_nonzero(check.beyond))
    said = (f'{check.identical} of {check.compared} recorded commands are reproduced to the bit, '
            f'{beyond} differ by more than {check.tolerance:g} K')
    return f'{said}; {_worst(bag, check)}'


def _why_nothing(bag: ReplayedBag) -> str:
    if bag.unanswered == len(bag.recorded):
        return 'no measurement has a recorded command'
    seconds = bag.replayed.given_seconds
    uncompared = f'commands of the first {seconds:g} s are' if seconds else 'first command is'
    return (f'the bag is too short, the {uncompared} not compared because the run had begun '
            'before it')


def _worst(bag: ReplayedBag, comparison: Comparison) -> str:
    worst = comparison.worst
    if worst is None:
        return 'none differs'
    return (f'the largest difference is {comparison.difference[worst]:+.3g} K, at '
            f'{bag.seconds[worst]:.3f} s (stamp {bag.stamps_ns[worst] / 1e9:.3f} s)')


def _about(parameters: ReplayParameters) -> str:
    text = (f'The recorded measurements and requests went through the control step again, with '
            f'the model `{parameters.model}` and the settings given. Times count from the first '
            'measurement of a bag.')
    if parameters.new_model:
        text += (f'\n\nThe commands of `{parameters.new_model}` answer the same recorded '
                 'measurements and tracked set-points, under the same limits. They are compared '
                 'with what was commanded then, measurement by measurement: not a closed loop, in '
                 'which the temperatures themselves would have become others.')
    return text


def _section(bag: ReplayedBag, parameters: ReplayParameters) -> list[str]:
    record = bag.record
    lines = [f'- {len(bag.recorded)} measurements over {np.ptp(bag.seconds) / 60.0:.2f} min.',
             f'- Recorded model: {verdict(bag)}.']
    if bag.new is not None:
        beyond = int(np.count_nonzero(bag.new.beyond))
        lines.append(f'- New model: {beyond} of {bag.new.compared} commands differ from the '
                     f'recorded ones by more than {parameters.tolerance:g} K; '
                     f'{_worst(bag, bag.new)}.')
    if record.models and record.models != (parameters.model,):
        lines.append('- The diagnostics in the bag name the model '
                     f'{", then ".join(record.models)}.')
    if bag.outside:
        lines.append(f'- At {bag.outside} measurements the tracked set-point is outside the range '
                     'that the new model was trained for, which would have refused it.')
    if record.began_before:
        lines.append(about_beginning(bag))
    for count, words in (
            (bag.replayed.adopted, 'set-points are taken from what was tracked, because no '
                                   'recorded request explains them'),
            (bag.replayed.refused, 'requests are refused'),
            (bag.unanswered, 'measurements have no recorded command'),
            (record.silences, 'commands were given because no measurement came'),
            (record.unmatched_commands, 'recorded commands answer no recorded measurement')):
        if count:
            lines.append(f'- {count} {words}.')
    if not record.complete:
        lines.append('- The bag was not closed or is damaged: this is the part that is whole.')
    if bag.check.compared and not reproduced(bag):
        lines.append('- The model or the settings given are not those of the recording, or they '
                     'were changed during it.')
    return lines


def about_beginning(bag: ReplayedBag) -> str:
    """Say what follows from a bag that begins in the middle of a run."""
    words = ('- The run had begun before the bag: the replay starts from the set-point and the '
             'command recorded first.')
    seconds = bag.replayed.given_seconds
    if seconds:
        words += (f' What the controller remembered then is not in the bag, above all its '
                  f'estimate of the disturbance, so that the commands of the first {seconds:g} s '
                  'are taken over and not compared; later ones can differ by what is left of '
                  'that memory.')
    return words


def _figures(bag: ReplayedBag) -> dict[str, Any]:
    figures: dict[str, Any] = {
        'bag': bag.path,
        'measurements': len(bag.recorded),
        'reproduced': reproduced(bag),
        'recorded_model': _comparison(bag, bag.check),
        'measurements_without_command': bag.unanswered,
        'commands_without_measurement': bag.record.unmatched_commands,
        'commands_in_silence': bag.record.silences,
        'adopted_setpoints': bag.replayed.adopted,
        'refused_requests': bag.replayed.refused,
        'began_before_bag': bag.record.began_before,
        'taken_over_s': bag.replayed.given_seconds,
        'models_in_diagnostics': list(bag.record.models),
        'complete': bag.record.complete,
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
        'largest_difference_K': 0.0 if worst is None else float(comparison.difference[worst]),
        'largest_at_s': None if worst is None else float(bag.seconds[worst]),
        'largest_at_stamp_ns': None if worst is None else int(bag.stamps_ns[worst]),
    }
