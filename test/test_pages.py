# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The pages point to what is there, and name and quote what the sources hold."""

import ast
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path
import re

from builtin_interfaces.msg import Time
import numpy as np
import pytest

from koopman_ros.control.laws import Plan
from koopman_ros.core.message_fields import KNOWN_TYPES, place
from koopman_ros.parameters.trainer import preset_wiring
from koopman_ros.ros import node_descriptions, topics
from koopman_ros.ros.controller_messages import active_constraints

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted(ROOT.glob('docs/**/*.md'))]
PARTS = 'koopman_ros|studies|benchmarks|examples|config|docs|test'
each_page = pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))


@each_page
def test_relative_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r'\]\(([^)\s]+)\)', page.read_text()):
        if re.match(r'[a-z]+:', link):
            continue
        target, _, anchor = link.partition('#')
        aim = page.parent / target if target else page
        assert aim.exists(), link
        if anchor:
            assert anchor in _anchors(aim), link


@each_page
def test_empty_texts_in_commands_have_the_quotes_that_ros_needs(page: Path) -> None:
    assert not re.findall(r"-p [\w./]+:=(?:''|\"\"|(?=\s))", page.read_text())


@each_page
def test_named_files_are_there(page: Path) -> None:
    for code in _inline_code(page):
        for name in re.findall(rf'(?<![/\w])(?:{PARTS})/[\w./*]*', code):
            assert list(ROOT.glob(name)), name


@each_page
def test_names_with_underscores_are_in_the_sources(page: Path) -> None:
    for code in _inline_code(page):
        if '::' not in code:  # names of C++ are others'
            assert set(re.findall(r'\b[a-z]\w*_\w+\b', code)) <= _words(), code


@each_page
def test_make_targets_are_in_the_makefile(page: Path) -> None:
    targets = set(re.findall(r'^([a-z-]+):.*##', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    assert set(re.findall(r'(?:`|^)make ([a-z-]+)', page.read_text(), re.MULTILINE)) <= targets


def test_pages_and_packages_are_listed_and_the_readme_is_short() -> None:
    listed = re.findall(r'^[\w/-]+$', (ROOT / 'docs' / 'index.md').read_text(), re.MULTILINE)
    assert {str(page.relative_to(ROOT / 'docs').with_suffix(''))
            for page in ROOT.glob('docs/**/*.md')
            if page.parts[-2] != 'api'} <= {*listed, 'index'}
    text = (ROOT / 'CONTRIBUTING.md').read_text()
    for package in ROOT.glob('koopman_ros/*/__init__.py'):
        assert f' koopman_ros/{package.parent.name}/ ' in text
    assert len((ROOT / 'README.md').read_text().splitlines()) <= 130


def test_continuous_integration_runs_what_the_pages_say() -> None:
    commands = re.findall(r'^make .*$', (ROOT / '.ci' / 'run').read_text(), re.MULTILINE)
    pages = (ROOT / 'README.md').read_text() + (ROOT / 'CONTRIBUTING.md').read_text()
    assert len(commands) > 3
    for command in commands:
        assert re.search(rf'(`|^){command}(`|$)', pages, re.MULTILINE), command


def test_interfaces_list_the_topics_with_their_types_and_the_services() -> None:
    assert [row[:2] for row in _rows('reference/interfaces.md') if '_msgs/' in row[1]
            and '`' not in row[1]
            ] == [[f'`{name}`', f'{kind.__module__.split(".")[0]}/{kind.__name__}']
                  for name, kind in topics.TYPES.items()]
    services = {row[0].strip('`') for row in _rows('reference/interfaces.md')
                if 'std_srvs/' in row[1]}
    text = (ROOT / 'docs' / 'reference/interfaces.md').read_text()
    managed = set(re.findall(r'`(~/\w+_\w+)`', text[text.index('## Lifecycle'):]))
    for name, node in node_descriptions.PROGRAMS.items():
        serves = set(node.serves) - set(node_descriptions.STANDARD_SERVICES)
        own = {service for service in serves if service.replace('~', f'/{name}') in services}
        assert serves - own == (managed & serves), name
        assert not serves - own or managed <= {*node.serves, *node.publishes}, name
        services -= {service.replace('~', f'/{name}') for service in own}
    assert not services


def test_interfaces_list_the_limits_of_a_plan() -> None:
    wiring, none = preset_wiring('reactor'), np.zeros(1)
    assert wiring is not None
    (state,), (given,) = wiring.signals.states, wiring.signals.inputs
    plan = Plan(*3 * (none,), none, none, none)
    names = active_constraints(wiring.signals, plan, Time(), '').name
    assert [row[0].strip('`') for row in _rows('reference/interfaces.md')
            if row[0].startswith('`at_')] == [
        name.replace(given, '<input>').replace(f'_{state} ', '_<state> ') for name in names]


@pytest.mark.parametrize(('system', 'column'), [('reactor', 2), ('two_tanks', 3)])
def test_interfaces_list_where_signals_are(system: str, column: int) -> None:
    wiring = preset_wiring(system)
    assert wiring is not None
    listed = {row[1].strip('`'): re.findall('`(.+?)`', row[column])
              for row in _rows('reference/interfaces.md') if re.match('`<(state|input)>.*topic`',
                                                                      row[1])}
    assert listed == {
        f'<{kind}>.{row.name}': [getattr(places, row.name) for places in of.values()]
        for kind, of in (('state', wiring.states), ('input', wiring.inputs))
        for row in fields(next(iter(of.values()))) if row.name.endswith('topic')}


def test_interfaces_list_the_message_types() -> None:
    text = (ROOT / 'docs' / 'reference/interfaces.md').read_text()
    for kind in KNOWN_TYPES:
        assert f'`{kind}`' in text
    rows = [row for row in _rows('reference/interfaces.md') if '/msg/' in row[1] and len(row) == 4]
    for units, kind, field, there in rows:
        for unit in units.replace('any other', 'V').split(', '):
            found = place('here', '<signal>', unit)
            assert [kind, field] == [f'`{found.type}`', f'`{found.field}`']
            assert there.replace('that of the signal', unit) == found.unit
    assert len(rows) > 4


def test_interfaces_list_what_there_is_of_each_signal() -> None:
    """Beside its places, with the unit of each."""
    rows = {row[0]: row[1:] for row in _rows('reference/interfaces.md') if 'unit]' in row[1]}
    for node, cells in rows.items():
        table = node_descriptions.tables()[node]
        for cell, kind in zip(cells, ('states', 'inputs'), strict=True):
            (name, unit), = table.signals[kind].items()
            listed = {}
            for names, symbol in re.findall(r'((?:`\w+`,? ?)+)\[(.+?)\]', cell):
                for parameter in re.findall(r'\w+', names):
                    listed[parameter] = symbol.replace('unit²', 'unit^2').replace('unit', unit)
            own = {row.removeprefix(f'{name}.'): about.unit.replace('degC', unit)
                   for row, about in table.rows.items()
                   if row.startswith(f'{name}.') and about.unit}
            assert listed == own, (node, kind)
    assert len(rows) == 3


def test_operation_quotes_what_diagnostics_say() -> None:
    quotes = [quote for row in _rows('reference/faults.md') if len(row) == 4
              for quote in re.findall('`(.+?)`', row[2])]
    assert len(quotes) > 15
    for quote in quotes:
        for part in quote.split('…'):
            assert any(part.strip(' ;:') in text for text in _texts()), quote


def _anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    headings = re.findall(r'^#+ (.+)$', page.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def _inline_code(page: Path) -> list[str]:
    """Return what a page sets in backticks within its lines."""
    text = re.sub(r'^```.*?^```', '', page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r'`([^`]+)`', text)


def _rows(page: str) -> Iterator[list[str]]:
    """Yield the cells of the rows of all tables of a page."""
    for line in (ROOT / 'docs' / page).read_text().splitlines():
        if line.startswith('|'):
            yield [cell.strip() for cell in line.strip('|').split('|')]


@cache
def _words() -> set[str]:
    """Return all words of the sources, and of the configuration."""
    paths = [ROOT / 'Makefile', *(path for part in PARTS.split('|') if part != 'docs'
                                  for path in ROOT.glob(f'{part}/**/*'))]
    wirings = map(preset_wiring, ('reactor', 'two_tanks'))
    of_topics = ' '.join(topic for wiring in wirings if wiring for topic in wiring.topics)
    return {word for path in paths if path.suffix in ('', '.py', '.yaml') and path.is_file()
            for word in re.findall(r'\w+', f'{path.stem} {path.read_text()}')
            } | set(re.findall(r'\w+', of_topics))


@cache
def _texts() -> list[str]:
    """Return the texts in the sources, what is put into them left out."""
    texts = []
    for path in ROOT.glob('koopman_ros/**/*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                texts.append('\0'.join(str(part.value) for part in node.values
                                       if isinstance(part, ast.Constant)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return texts
