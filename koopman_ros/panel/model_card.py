# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Words for the current model: origin and figures in its file, and in the controller's status."""

from collections.abc import Mapping, Sequence
import contextlib
from datetime import datetime

from koopman_ros.model import LiftedModel
from koopman_ros.panel.faceplates import Range, readable
from koopman_ros.panel.snapshot import CONTROL, Snapshot, TRAINER, TRAINING

_STATUS = {'model file time': 'File written', 'model training data': 'Training data (digest)',
           'model reloads': 'Reloads', 'model rejected': 'Last file rejected',
           'model check': 'Check on recent data', 'law': 'Control law',
           'gain norm': 'Norm of the feedback gain',
           'predicted growth per sample': 'Decay of errors per sample (1: none)'}
#: figures of a training, by their key without the signal
_TRAINING = {'step': 'Step', 'model_class': 'Model class',
             'measurements_used': 'Measurements used',
             'derivative_method': 'Derivatives', 'noise': 'Measurement noise',
             'heldout_error': 'Held-out error',
             'heldout_error_of_current_model': 'Held-out error of the current model',
             'heldout_error_of_linear_model': 'Held-out error of a linear model',
             'closed_loops': 'Simulated closed loops', 'closed_loops_failed': 'of these failed',
             'closed_loop_cost_over_linear': 'Closed-loop cost relative to linear control'}
_LAWS = {'re-centred': 'linear around the set-point',
         'averaged': 'linear between state and set-point'}
_COMPARED = ('Model class', 'Acceptance')
_OUTSIDE = ' outside training box [half-ranges]'
_UNKNOWN = ('', 'none', 'nan')


def training_ranges(model: LiftedModel) -> dict[str, Range]:
    """Return the training range of each signal, in its unit."""
    return {name: (low, high) for signals in (model.states, model.joined.inputs)
            for name, low, high in zip(signals.names, signals.lower.tolist(),
                                       signals.upper.tolist(), strict=True)}


def model_card(model: LiftedModel) -> dict[str, str]:
    """Return origin and held-out figures of a model, by their names in words."""
    origin = model.provenance
    found = {
        'Model class': model.kind,
        'Acceptance': origin.acceptance,
        'Closed loops': origin.closed_loops,
        'Learned from': origin.plant, 'Derivatives': origin.method,
        'Written by': f'koopman_ros {origin.package_version}' if origin.package_version else '',
        'Random seed': '' if origin.seed is None else str(origin.seed)}
    return found | {title: f'{figure:.4g}' for title, figure in model.figures.items()}


def model_changes(now: Snapshot, name: str, new: LiftedModel, trained: Mapping[str, Range]
                  ) -> list[Sequence[str]]:
    """
    Return the changes by a new model: a title, and the value of the active and the new model.

    Errors are those of both models on the same data: the last training has them if it compared
    these two. Figures in the files are of the data of each.

    :param name: file of the new model.
    :param trained: training ranges of the new model, in the units in which people read them.
    """
    rows: list[Sequence[str]] = []
    for face in (*now.states, *now.inputs):
        other = trained.get(face.name)
        active, wanted = (face.span_text(bounds) if bounds else '–'
                          for bounds in (face.training, other))
        rows.append((f'Training range, {face.label} [{face.unit}]', active, wanted))
        if face.training and other:
            rows += [(f'  {word} by the new model', '', '; '.join(
                face.span_text(part) for part in parts))
                for word, parts in (('gained', _beyond(other, face.training)),
                                    ('lost', _beyond(face.training, other))) if parts]
    card = model_card(new)
    # the reasons of a verdict fill no column
    rows += [(title, *(one.get(title, '–').partition(' (')[0] for one in (now.model, card)))
             for title in _COMPARED]
    training, active = now.status(TRAINING).values, now.status(CONTROL).values.get('model', '')
    signals = [key.partition(': ')[2] for key in training if key.startswith('heldout_error: ')]
    # the trainer compares with the model of its parameter
    same = training.get('model_file') == name and active == now.parameter(TRAINER, 'model')
    rows += [(f'Error on the new record, {readable(signal)} [{training.get(f"units: {signal}")}]',
              brief(training.get(f'heldout_error_of_current_model: {signal}', '–')),
              brief(training[f'heldout_error: {signal}'])) for signal in signals if same]
    if not (same and signals):
        rows.append(('Error on the same data', 'not known', 'compare on the last hour first'))
    return rows


def _beyond(one: Range, other: Range) -> list[Range]:
    """Return the parts of a range outside another."""
    parts = (one[0], min(one[1], other[0])), (max(one[0], other[1]), one[1])
    return [part for part in parts if part[0] < part[1]]


def brief(value: str) -> str:
    """Write a figure with four digits; other texts stay."""
    try:
        return f'{float(value):.4g}' if '.' in value else value
    except ValueError:
        return value


def training_card(values: Mapping[str, str]) -> dict[str, str]:
    """Return the figures of a training in the trainer's status, by their names in words."""
    found = {}
    for key, value in values.items():
        title, _, signal = key.partition(': ')
        if key.startswith(('class ', 'constant ')):
            found[key[:1].upper() + key[1:]] = value
        elif title in _TRAINING:
            unit = values.get(f'units: {signal}', '')
            found[f'{_TRAINING[title]}, {readable(signal)} [{unit}]' if signal
                  else _TRAINING[title]] = value
    return found


def status_card(values: Mapping[str, str]) -> dict[str, str]:
    """Return the figures of the model in the controller's status, by their names in words."""
    found = {title: values.get(key, '') for key, title in _STATUS.items()}
    found['Control law'] = _LAWS.get(found['Control law'], found['Control law'])
    with contextlib.suppress(ValueError):
        # in local time, as the other times on the page
        written = datetime.fromisoformat(found['File written']).astimezone()
        found['File written'] = f'{written:%Y-%m-%d %H:%M:%S}'
    for key, value in values.items():
        if key.endswith(_OUTSIDE):
            name = key.removesuffix(_OUTSIDE)
            subject = 'State' if name == 'distance' else readable(name).capitalize()
            found[f'{subject} outside the training range [half-ranges]'] = value
    return {title: value for title, value in found.items() if value not in _UNKNOWN}
