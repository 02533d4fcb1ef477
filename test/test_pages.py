# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The pages point to what is there, and name and quote what the sources hold."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
import re

import pytest

from koopman_ros.ros import programs, topics

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted(ROOT.glob('docs/*.md'))]
PARTS = 'koopman_ros|validation|examples|config|docs|test'
each_page = pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)


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
    listed = re.findall(r'^\w+$', (ROOT / 'docs' / 'index.md').read_text(), re.MULTILINE)
    assert {page.stem for page in ROOT.glob('docs/*.md')} <= {*listed, 'index'}
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
    assert [row[:2] for row in _rows('interfaces.md') if '_msgs/' in row[1]] == [
        [f'`{name}`', f'{kind.__module__.split(".")[0]}/{kind.__name__}']
        for name, kind in topics.TYPES.items()]
    services = {row[0].strip('`') for row in _rows('interfaces.md') if 'std_srvs/' in row[1]}
    assert services == {
        service.replace('~', f'/{name}') for name, node in programs.PROGRAMS.items()
        for service in node.serves if service not in programs.STANDARD_SERVICES}


def test_operation_quotes_what_diagnostics_say() -> None:
    quotes = [quote for row in _rows('operation.md') if len(row) == 5
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
    return {word for path in paths if path.suffix in ('', '.py', '.yaml') and path.is_file()
            for word in re.findall(r'\w+', f'{path.stem} {path.read_text()}')}


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
