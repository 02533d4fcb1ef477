# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Report of a training and of a replay, read from their files: figures, text and a picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

from koopman_ros.panel.files import read_bounded, sanitize_text
from koopman_ros.units import unit_label

MAX_TEXT = 1_000_000  # bytes of a page or of figures
MAX_PICTURE = 16_000_000  # bytes
_MAX_LINES = 40
_MAX_LINE, _MAX_NAME = 500, 60  # characters
_PNG, _PNG_END = b'\x89PNG\r\n\x1a\n', b'IEND\xaeB`\x82'
_ENDINGS = ('.refused.safetensors', '.safetensors')
# Figures of the trainer's status that tell one training from another.
_IDENTIFYING = ('accepted', 'measurements_read', 'measurements_used', 'model_file')
_TRAINED = {
    'model_class': 'Model class', 'heldout_error': 'Error on held-out records',
    'heldout_error_of_present_lift': 'Error of the present model',
    'heldout_error_of_linear_model': 'Error of the best linear model',
    'noise': 'Measurement noise', 'closed_loops': 'Closed loops tested',
    'closed_loops_failed': 'Closed loops failed', 'condition': 'Condition number',
    'trained_from': 'Trained from', 'trained_to': 'Trained to', 'coverage': 'Cells visited',
    'measurements_read': 'Measurements read', 'measurements_used': 'Measurements used'}
_COMPARED = {'compared': 'Commands compared', 'beyond_tolerance': 'Commands that differ',
             'largest_difference': 'Largest difference', 'largest_at_s': 'Time of it [s]'}


@dataclass(frozen=True)
class Findings:
    """Content of a report."""

    problem: str = ''  #: why there is no result, or empty
    lines: tuple[str, ...] = ()
    figures: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    text: str = ''  #: the whole report
    picture: bytes = b''  #: PNG, or empty


@dataclass(frozen=True)
class Report(Findings):
    """Report of a training; its lines are reasons and warnings."""

    written: float = 0.0  #: wall time
    accepted: bool = False
    model_file: str = ''  #: of the new model, or empty


@dataclass(frozen=True)
class Comparison(Findings):
    """Replay with a new model, compared with the recorded commands."""

    model: str = ''  #: the new one, or empty before the first comparison
    since: float = 0.0  #: wall time of its start
    running: bool = False


@dataclass
class Learning:
    """The last training and comparison; each is replaced as a whole, from any thread."""

    report: Report | None = None  #: None before the first training
    comparison: Comparison = Comparison()

    def picture(self, name: str) -> bytes:
        """Return the picture of a training or a comparison; empty for none."""
        found = {'training': self.report, 'comparison': self.comparison}.get(name)
        return found.picture if found else b''


def report_base(model_file: str) -> Path | None:
    """Return the path of the files of a training without ending; None for another file."""
    for ending in _ENDINGS:
        if model_file.endswith(ending):
            return Path(model_file.removesuffix(ending)).expanduser()
    return None


def report_time(base: Path) -> int:
    """Return the time of writing of a report in ns, 0 for none."""
    # the figures are written before text and picture
    times = [0]
    for ending in ('.json', '.md', '.png'):
        with contextlib.suppress(OSError):
            times.append(os.stat(f'{base}{ending}').st_mtime_ns)
    return max(times)


def read_report(base: Path, trained: Mapping[str, str] = MappingProxyType({})) -> Report:
    """
    Return the report beside a model.

    :param trained: figures of the trainer's status; a report with others is a problem.
    """
    path = Path(f'{base}.json')
    try:
        figures = _figures_of(path)
        written = os.stat(path).st_mtime
    except (OSError, ValueError) as error:
        return Report('the panel cannot read the report, perhaps it is on another machine: '
                      f'{sanitize_text(str(error), _MAX_LINE)}')
    if any(name in trained and trained[name] != str(figures.get(name)) for name in _IDENTIFYING):
        return Report(f'the panel cannot read the report: {path} is of another training')
    units = figures.get('units')
    return Report(
        '', (*_texts(figures.get('reasons')),
             *(f'Warning: {text}' for text in _texts(figures.get('warnings')))),
        dict(_rows(figures, _TRAINED, units if isinstance(units, Mapping) else {})),
        _read_text(Path(f'{base}.md')), _read_picture(Path(f'{base}.png')), written,
        figures.get('accepted') is True, str(figures.get('model_file') or ''))


def read_comparison(folder: Path, model: str, since: float, output: str) -> Comparison:
    """Return the result of a replay; without one, the last lines of its output."""
    try:
        (bag,) = _figures_of(folder / 'summary.json')['bags']
        line = ('The recorded commands are reproduced.' if bag['reproduced'] is True else
                'The recorded commands are not all reproduced: see the whole report.')
        figures = {
            'Measurements': str(bag['measurements']), **dict(_rows(bag['new_model'], _COMPARED)),
            'Commands of the active model that differ': str(
                bag['recorded_model']['beyond_tolerance'])}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        last = ' '.join([line for line in output.splitlines() if line.strip()][-3:])
        return Comparison('the replay failed: ' + (
            sanitize_text(last, _MAX_LINE) or 'it has no output'), model=model, since=since)
    return Comparison('', (line,), figures, _read_text(folder / 'report.md'),
                      _read_picture(folder / 'replay.png'), model, since)


def _read_text(path: Path) -> str:
    try:
        return read_bounded(path, MAX_TEXT)[0].decode('utf-8', 'replace')
    except (OSError, ValueError):
        return ''


def _read_picture(path: Path) -> bytes:
    try:
        found = read_bounded(path, MAX_PICTURE)[0]
    except (OSError, ValueError):
        return b''
    return found if found.startswith(_PNG) and found.endswith(_PNG_END) else b''


def _figures_of(path: Path) -> Mapping[str, Any]:
    try:
        found = json.loads(read_bounded(path, MAX_TEXT)[0])
    except RecursionError:
        raise ValueError(f'{path} is nested too deeply') from None
    if not isinstance(found, dict):
        raise ValueError(f'{path} holds no figures')
    return found


def _texts(found: Any) -> Iterator[str]:
    for one in (found if isinstance(found, list) else [])[:_MAX_LINES]:
        yield sanitize_text(str(one), _MAX_LINE)


def _rows(figures: Mapping[str, Any], titles: Mapping[str, str],
          units: Mapping[str, Any] = MappingProxyType({})) -> Iterator[tuple[str, str]]:
    """Return the figures that have titles, and those of each signal with its unit."""
    for key, title in titles.items():
        value = figures.get(key)
        if isinstance(value, Mapping):
            for name, one in list(value.items())[:_MAX_LINES]:
                about = f'{title}: {sanitize_text(str(name), _MAX_NAME)}'
                yield about if len(value) > 1 else title, (
                    f'{_brief(one)} {_unit(str(units.get(name, "")))}'.strip())
        elif value is not None:
            yield title, _brief(value)


def _unit(unit: str) -> str:
    # the figures are in units of the model, where K may be a difference
    return unit if unit == 'K' else unit_label(sanitize_text(unit, _MAX_NAME))


def _brief(value: Any) -> str:
    if value is None:
        return 'infinite'
    return f'{value:.4g}' if isinstance(value, float) else sanitize_text(str(value), _MAX_LINE)
