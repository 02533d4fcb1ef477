# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What a training and a replay leave in files: figures, a page and a picture, read with care.

Nothing in them is taken for more than text, a number, or a picture of bounded size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import stat
import struct
from types import MappingProxyType
from typing import Any

from koopman_ros.panel.texts import plain
from koopman_ros.units import unit_label

MAX_TEXT = 1_000_000  # bytes of a page or of figures
MAX_PICTURE = 16_000_000  # bytes
MAX_PIXELS = 100_000_000
_MAX_LINES = 40
_MAX_LINE, _MAX_NAME = 500, 60  # characters
_PNG, _PNG_END = b'\x89PNG\r\n\x1a\n', b'IEND\xaeB`\x82'
_ENDINGS = ('.refused.safetensors', '.safetensors')
# What tells one training from another, of what a trainer says of it.
_TOLD = ('accepted', 'measurements_read', 'measurements_used', 'model_file')
_TRAINED = {
    'model_class': 'class', 'heldout_error': 'error on held-out records',
    'heldout_error_of_present_lift': 'that of the present model',
    'heldout_error_of_linear_model': 'that of the best linear model', 'noise': 'noise',
    'closed_loops_failed': 'closed loops that failed', 'closed_loops': 'of',
    'condition': 'condition number', 'trained_from': 'trained from', 'trained_to': 'trained to',
    'coverage': 'cells visited', 'measurements_used': 'measurements used',
    'measurements_read': 'of'}
_COMPARED = {'compared': 'commands compared', 'beyond_tolerance': 'that differ by more',
             'largest_difference': 'largest difference', 'largest_at_s': 'at [s]'}
_NO_FIGURES: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Report:
    """The report of a training, as far as it can be read here."""

    problem: str = ''  #: why it cannot be read, or empty
    written: float = 0.0  #: when, by the wall clock
    accepted: bool = False
    model_file: str = ''  #: where the new model is, or empty
    lines: tuple[str, ...] = ()  #: reasons and warnings
    figures: Mapping[str, str] = field(default_factory=lambda: _NO_FIGURES)
    text: str = ''  #: the page
    picture: bytes = b''  #: PNG, or empty


@dataclass(frozen=True)
class Comparison:
    """A replay with a new model beside the acting one."""

    model: str = ''  #: the new one, or empty where nothing was compared
    since: float = 0.0  #: when it was begun, by the wall clock
    running: bool = False
    problem: str = ''  #: why there is no result, or empty
    lines: tuple[str, ...] = ()
    figures: Mapping[str, str] = field(default_factory=lambda: _NO_FIGURES)
    text: str = ''
    picture: bytes = b''


@dataclass
class Learning:
    """The last training and comparison; each is replaced as a whole, from any thread."""

    report: Report | None = None  #: None where there was no training
    comparison: Comparison = Comparison()

    def picture(self, name: str) -> bytes:
        """Return a picture by the name of what it is of; empty where there is none."""
        report = self.report
        return {'training': report.picture if report else b'',
                'comparison': self.comparison.picture}.get(name, b'')


def read_bounded(path: Path, most: int) -> bytes:
    """Return the bytes of a regular file; OSError or ValueError where it is none, or too large."""
    # a pipe would not come back
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        found = os.fstat(number)
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f'{path} is no regular file')
        if found.st_size > most:
            raise ValueError(f'{path} has {found.st_size} bytes, at most {most} are read')
        with open(number, 'rb', closefd=False) as file:
            return file.read(most)
    finally:
        os.close(number)


def read_picture(path: Path) -> bytes:
    """Return a whole PNG picture of bounded size, empty where there is none."""
    try:
        found = read_bounded(path, MAX_PICTURE)
    except (OSError, ValueError):
        return b''
    if not found.startswith(_PNG) or not found.endswith(_PNG_END) or len(found) < 33:
        return b''
    width, height = struct.unpack('>II', found[16:24])
    return found if 0 < width * height <= MAX_PIXELS else b''


def read_page(path: Path) -> str:
    """Return a page as text, empty where there is none."""
    try:
        return read_bounded(path, MAX_TEXT).decode('utf-8', 'replace')
    except (OSError, ValueError):
        return ''


def report_base(model_file: str) -> Path | None:
    """Return where the files of a training are, without their endings; None for no model file."""
    for ending in _ENDINGS:
        if model_file.endswith(ending):
            return Path(model_file.removesuffix(ending)).expanduser()
    return None


def report_state(base: Path) -> tuple[tuple[int, int], ...]:
    """Return what changes when the files of a report do."""
    found = []
    for ending in ('.json', '.md', '.png'):
        try:
            about = os.stat(f'{base}{ending}')
            found.append((about.st_mtime_ns, about.st_size))
        except OSError:
            found.append((0, 0))
    return tuple(found)


def read_report(base: Path, told: Mapping[str, str] = MappingProxyType({})) -> Report:
    """
    Return the report beside a model.

    :param told: what the trainer said of the training; a report of another one is a problem.
    """
    path = Path(f'{base}.json')
    try:
        written = os.stat(path).st_mtime
        figures = _figures_of(path)
    except (OSError, ValueError) as error:
        return Report(f'the panel cannot read the report here, perhaps it is on another machine: '
                      f'{plain(str(error), _MAX_LINE)}')
    for name in _TOLD:
        if name in told and told[name] != str(figures.get(name)):
            return Report(f'the panel cannot read the report here: {path} is of another training')
    units = figures.get('units')
    return Report(
        written=written, accepted=figures.get('accepted') is True,
        model_file=str(figures.get('model_file') or ''),
        lines=(*_texts(figures.get('reasons')),
               *(f'Beware: {text}' for text in _texts(figures.get('warnings')))),
        figures=dict(_rows(figures, _TRAINED, units if isinstance(units, Mapping) else {})),
        text=read_page(Path(f'{base}.md')), picture=read_picture(Path(f'{base}.png')))


def read_comparison(folder: Path, model: str, since: float, said: str) -> Comparison:
    """Return what a replay left in its folder; `said` is what it printed, in place of that."""
    try:
        found = _figures_of(folder / 'summary.json')
        (bag,) = found['bags']
        recorded, new = bag['recorded_model'], bag['new_model']
        beside = ('the recorded commands are reproduced' if bag['reproduced'] is True else
                  'the recorded commands are not all reproduced: see the whole report')
        figures = {
            'measurements': str(bag['measurements']),
            **dict(_rows(new, _COMPARED, {})),
            'acting model: commands that differ': str(recorded['beyond_tolerance'])}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        last = [line for line in said.splitlines() if line.strip()][-3:]
        return Comparison(model, since, problem='the replay failed: ' + (
            plain(' '.join(last), _MAX_LINE) or 'it said nothing'))
    return Comparison(model, since, lines=(beside,), figures=figures,
                      text=read_page(folder / 'report.md'),
                      picture=read_picture(folder / 'replay.png'))


def _figures_of(path: Path) -> Mapping[str, Any]:
    try:
        found = json.loads(read_bounded(path, MAX_TEXT))
    except RecursionError:
        raise ValueError(f'{path} is nested too deeply') from None
    if not isinstance(found, dict):
        raise ValueError(f'{path} holds no figures')
    return found


def _texts(found: Any) -> Iterator[str]:
    for one in (found if isinstance(found, list) else [])[:_MAX_LINES]:
        yield plain(str(one), _MAX_LINE)


def _rows(figures: Mapping[str, Any], titles: Mapping[str, str], units: Mapping[str, Any]
          ) -> Iterator[tuple[str, str]]:
    """Return those figures that have titles; a share or count may follow what it belongs to."""
    last = ''
    for key, title in titles.items():
        value = figures.get(key)
        if value is None:
            continue
        if title == 'of':
            title = f'{last}, of'
        last = title
        if isinstance(value, Mapping):
            for name, one in list(value.items())[:_MAX_LINES]:
                unit = units.get(name, '')
                of = f'{title}: {plain(str(name), _MAX_NAME)}' if len(value) > 1 else title
                yield of, f'{_brief(one)} {_unit(unit)}'.strip()
        else:
            yield title, _brief(value)


def _unit(unit: Any) -> str:
    # of differences, and as the model has it
    return plain(str(unit), _MAX_NAME) if unit == 'K' else unit_label(plain(str(unit), _MAX_NAME))


def _brief(value: Any) -> str:
    if value is None:
        return 'infinite'
    return f'{value:.4g}' if isinstance(value, float) else plain(str(value), _MAX_LINE)
