# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Report of a training and of a replay, read from their files: verdict, text and a picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
from dataclasses import dataclass
import json
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

from koopman_ros.panel.files import read_bounded, sanitize_text

MAX_TEXT = 1_000_000  # bytes of a text or of figures
MAX_PICTURE = 16_000_000  # bytes
_MAX_LINES, _MAX_LINE = 40, 500  # characters
_PNG, _PNG_END = b'\x89PNG\r\n\x1a\n', b'IEND\xaeB`\x82'
_ENDINGS = ('.rejected.safetensors', '.safetensors')
# Figures of the trainer's status that tell one training from another.
_IDENTIFYING = ('accepted', 'measurements_read', 'measurements_used', 'model_file')


@dataclass(frozen=True)
class Findings:
    """Content of a report."""

    problem: str = ''  #: why there is no result, or empty
    lines: tuple[str, ...] = ()
    text: str = ''  #: the whole report
    picture: bytes = b''  #: PNG, or empty


@dataclass(frozen=True)
class TrainingReport(Findings):
    """Report of a training; its lines are reasons and warnings."""

    written: float = 0.0  #: wall time
    accepted: bool = False
    model_file: str = ''  #: of the new model, or empty


@dataclass(frozen=True)
class ReplayComparison(Findings):
    """Replay with a new model, compared with the recorded commands."""

    model: str = ''  #: the new one, or empty before the first comparison
    since: float = 0.0  #: wall time of its start
    running: bool = False


@dataclass
class Learning:
    """The last training and comparison; each is replaced as a whole, from any thread."""

    report: TrainingReport | None = None  #: None before the first training
    comparison: ReplayComparison = ReplayComparison()

    def new_model(self, trained: Mapping[str, str]) -> tuple[str, bool]:
        """
        Return the file of the last trained model, or '', and whether training rejected it.

        :param trained: figures of the trainer's status, which a restarted trainer has not.
        """
        if file := trained.get('model_file', ''):
            return file, trained.get('accepted') == 'False'
        found = self.report
        return (found.model_file, not found.accepted) if found else ('', False)

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
    times = [0]
    for ending in ('.json', '.md', '.png'):
        with contextlib.suppress(OSError):
            times.append(os.stat(f'{base}{ending}').st_mtime_ns)
    return max(times)


def read_report(base: Path, trained: Mapping[str, str] = MappingProxyType({})) -> TrainingReport:
    """
    Return the report of a model.

    :param trained: figures of the trainer's status; a report with others is a problem.
    """
    path = Path(f'{base}.json')
    try:
        figures = _figures_of(path)
    except (OSError, ValueError) as error:
        return TrainingReport('the panel cannot read the report (is it on another machine?): '
                              f'{sanitize_text(str(error), _MAX_LINE)}')
    if any(name in trained and trained[name] != str(figures.get(name)) for name in _IDENTIFYING):
        return TrainingReport(f'the panel cannot read the report: {path} belongs to another '
                              'training')
    return TrainingReport(
        lines=(*_texts(figures.get('reasons')),
               *(f'Warning: {text}' for text in _texts(figures.get('warnings')))),
        text=_read_text(Path(f'{base}.md')), picture=_read_picture(Path(f'{base}.png')),
        written=report_time(base) / 1e9, accepted=figures.get('accepted') is True,
        model_file=str(figures.get('model_file') or ''))


def read_comparison(folder: Path, model: str, since: float, output: str) -> ReplayComparison:
    """Return the result of a replay; without one, the last lines of its output."""
    try:
        (bag,) = _figures_of(folder / 'summary.json')['bags']
        new = bag['new_model']
        lines = (
            'The recorded commands are reproduced.' if bag['reproduced'] is True else
            'The recorded commands are not all reproduced: see the whole report.',
            sanitize_text(f'{new["beyond_tolerance"]} of {new["compared"]} commands of the new '
                          'model differ from the recorded ones.', _MAX_LINE))
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        last = ' '.join([line for line in output.splitlines() if line.strip()][-3:])
        return ReplayComparison('the replay failed: ' + (
            sanitize_text(last, _MAX_LINE) or 'it has no output'), model=model, since=since)
    return ReplayComparison('', lines, _read_text(folder / 'report.md'),
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
        raise ValueError(f'{path} contains no figures')
    return found


def _texts(found: Any) -> Iterator[str]:
    for one in (found if isinstance(found, list) else [])[:_MAX_LINES]:
        yield sanitize_text(str(one), _MAX_LINE)
