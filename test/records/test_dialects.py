# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tables as loggers write them are read right, or refused with the cell and the next step."""

import contextlib
import os
from pathlib import Path
import random
import re

import numpy as np
import pytest

from koopman_ros.records import read, Record
from support.logger_tables import Dialect, DIALECTS, FLOW, LEVEL, SECONDS

PAGE = Path(__file__).parents[2] / 'docs/tutorials/without_ros.md'


def write(folder: Path, dialect: Dialect, text: str | None = None) -> Path:
    path = folder / f'log{dialect.suffix}'
    path.write_bytes((dialect.text if text is None else text).encode(
        dialect.encoding, 'surrogatepass'))
    return path


def read_dialect(path: Path, dialect: Dialect) -> Record:
    return read(path, dialect.states, dialect.inputs)


@pytest.mark.parametrize('name', DIALECTS)
def test_each_dialect_is_read_right_or_refused(tmp_path: Path, name: str) -> None:
    dialect = DIALECTS[name]
    path = write(tmp_path, dialect)
    if dialect.refused:
        with pytest.raises(ValueError, match=dialect.refused) as error:
            read_dialect(path, dialect)
        assert str(path) in str(error.value)
        return
    (episode,) = read_dialect(path, dialect).episodes
    assert episode.time == pytest.approx(SECONDS)
    assert episode.x[:, 0] == pytest.approx(LEVEL)
    assert episode.inputs_at(SECONDS)[:, 0] == pytest.approx(FLOW)


def test_the_page_lists_the_dialects_as_they_are() -> None:
    listed = {name.strip('`'): verdict for verdict, names in re.findall(
        r'^\|(read|refused)\b[^|]*\|(.+)\|$', PAGE.read_text(), re.MULTILINE)
        for name in names.split('; ')}
    assert listed == {name: 'refused' if one.refused else 'read'
                      for name, one in DIALECTS.items()}


def said(record: Record) -> list[str]:
    """Return what a record says about rows that are not as they were."""
    return record.report.lines()[1:]


def difference(record: Record) -> str:
    """Return where a record has other values than the truth, or has them at other times."""
    for episode in record.episodes:
        places = [np.flatnonzero(np.isclose(LEVEL, x, atol=1e-6)) for x in episode.x[:, 0]]
        if not all(map(len, places)):
            return f'values {episode.x[[not len(one) for one in places], 0]}'
        first = next((int(k) for k in places[0] if all(
            np.isclose(SECONDS[one], SECONDS[k] + t, atol=1e-3).any()
            for one, t in zip(places, episode.time, strict=True))), None)
        if first is None:
            return f'times {episode.time}'
        rows = np.rint((episode.time + SECONDS[first]) / SECONDS[1]).astype(int)
        # an input that changes at the last measurement acts on none
        if not np.allclose(episode.inputs_at(episode.time[:-1])[:, 0], FLOW[rows[:-1]]):
            return f'inputs {episode.u}'
    return ''


MUTATED = ('commas', 'semicolons', '"1,234.5"', '1.234,5', '31.01.2026',
           'InfluxDB', 'TOA5', 'HOBO', 'LabVIEW', 'time, tag, value')
SPECIAL = ('', 'Bad', '-', 'NaN', '1e400', '9' * 400, '12:00', '#DIV/0!', '0x1F', '"',
           '1,5,5', '-1.#IND', '5.5.5')
STARTS, COUNTS = re.compile(r'(?<!\d)\d'), re.compile(r'\d|(?<=\d)[.,](?=\d)')
MARKS = ',;\t"\'.# \x00éT:-/\n\u202f'


def mutated(text: str, rng: random.Random) -> str:
    """
    Return a table in which something has changed.

    Digits, decimal marks and signs are left alone: a changed one gives another valid number, which
    no reader could recognise as wrong.
    """
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        lines, at = text.split('\n'), rng.randrange(len(text))
        line = rng.randrange(len(lines))
        kind = rng.randrange(8)
        if kind == 0:
            marks = MARKS.replace('-', '') if STARTS.match(text, at) else MARKS
            text = text[:at] + rng.choice(marks) + text[at:]
        elif kind == 1 and not COUNTS.match(text, at):
            text = text[:at] + text[at + 1:]
        elif kind == 2 and not text[at].isdigit():
            text = text[:at] + rng.choice(MARKS) + text[at + 1:]
        elif kind == 3:
            text = text[:at]
        elif kind == 4:
            lines.insert(line, rng.choice(['', 'restarted', '# 12', ',,,', lines[0], lines[-2]]))
            text = '\n'.join(lines)
        elif kind == 5:
            other = rng.randrange(len(lines))
            lines[line], lines[other] = lines[other], lines[line]
            text = '\n'.join(lines)
        else:
            separator = next(one for one in '\t;,' if one in lines[-2:][0] or one == ',')
            cells = lines[line].split(separator)
            cells[rng.randrange(len(cells))] = rng.choice(SPECIAL)
            lines[line] = separator.join(cells)
            text = '\n'.join(lines)
        if not text:
            break
    return text


@pytest.mark.parametrize('name', MUTATED)
def test_a_mutated_table_gives_the_truth_or_says_what_differs(tmp_path: Path, name: str) -> None:
    rng = random.Random(f'{name} {os.environ.get("TABLE_SEED", "1")}')
    dialect = DIALECTS[name]
    usual = said(read_dialect(write(tmp_path, dialect), dialect))
    for _ in range(int(os.environ.get('MUTATED_TABLES', '12'))):
        text = mutated(dialect.text, rng)
        with contextlib.suppress(ValueError):
            record = read_dialect(write(tmp_path, dialect, text), dialect)
            found = difference(record)
            assert not found or said(record) != usual, (found, text)
