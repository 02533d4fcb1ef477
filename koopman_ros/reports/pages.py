# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Pages for people, in Markdown, and figures for programs, in JSON."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
import json
import math
import os
from pathlib import Path
from typing import Any

from koopman_ros.reports.machine import headline


@dataclass(frozen=True)
class Picture:
    """A picture of a page."""

    file: str  #: its name, in the folder of the page
    caption: str  #: what it shows, with its numbers

    def __str__(self) -> str:
        """Return the picture with its caption, in Markdown."""
        return f'![{self.caption.partition(". ")[0]}]({self.file})\n\n*{self.caption}*'


def table(head: Sequence[str], rows: Iterable[Sequence[object]], numbers: Collection[int] = ()
          ) -> str:
    """
    Return a table in Markdown.

    :param head: titles of the columns, units in brackets.
    :param rows: a cell a column.
    :param numbers: columns that are flush right.
    """
    rule = ['---:' if column in numbers else '---' for column in range(len(head))]
    lines = [f'| {" | ".join(head)} |', f'|{"|".join(rule)}|']
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f'a row of {len(row)} cells in a table of {len(head)} columns: '
                             f'{row}')
        lines.append(f'| {" | ".join(str(cell).replace("|", chr(92) + "|") for cell in row)} |')
    return '\n'.join(lines)


def bullets(lines: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return '\n'.join(f'- {line}' for line in lines)


def write_page(path: Path, title: str, sections: Iterable[str], packages: Sequence[str] = ()
               ) -> Path:
    """
    Write a page in Markdown; it names the versions and the machine below its title.

    :param path: the file; its folder is made.
    :param title: of the page.
    :param sections: paragraphs, headings, tables, pictures; empty ones are left out.
    :param packages: whose versions matter, beside this package's.
    :return: the file.
    """
    parts = [f'# {title}', f'*{headline(*packages)}*', *filter(None, map(str, sections))]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('\n\n'.join(parts) + '\n', encoding='utf-8')
    return path


def write_figures(path: Path, figures: Mapping[str, Any]) -> Path:
    """
    Write figures as JSON; an interrupt leaves the old file or the new one, never a part.

    :param path: the file; its folder is made.
    :param figures: by name; infinity and NaN, which JSON does not know, become null.
    :return: the file.
    """
    text = json.dumps(_finite(figures), indent=2, allow_nan=False) + '\n'
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + '.part')
    beside.write_text(text, encoding='utf-8')
    os.replace(beside, path)
    return path


def _finite(value: Any) -> Any:
    """Replace what JSON does not know by None, however deep it is nested."""
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
