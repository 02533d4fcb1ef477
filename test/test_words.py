# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Pages, messages and docstrings are plain technical English: none of a list of odd phrases."""

import ast
from collections.abc import Iterator
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [*(ROOT / name for name in ('README.md', 'CONTRIBUTING.md', 'CHANGELOG.rst')),
         *sorted(ROOT.glob('docs/**/*.md'))]
ODD = (
    'anew', 'afresh', 'asked for', 'beside', 'besides', 'goes by', 'go by',
    r'is said', 'are said', 'whoever', 'whose turn', 'somebody', 'nobody', 'anybody',
    "one's own", 'of before', 'what acts', 'what is', 'what was', 'what are', 'to the bit',
    'by itself alone', 'by hand', 'where it is not said', '(?:stands?|stood) still',
    'must hold to', 'is heard', 'hears', 'likewise', 'as it stands', 'far astray', 'leads? back',
    'let go', 'told', 'tells', 'foresees?', 'can be no',
    '(?<!there )(?:is|are) no (?!longer|more|better)')
# Nouns in place of clauses: the applied input, not what acts. The code has no 'what' to explain.
ODD_IN_CODE = (*ODD, r'what(?! to\b| if\b)', 'so many', 'so much', 'foreseen', 'has it',
               'asks for', 'there (?:is|are) not', 'heard')
PACKAGES = sorted(path for path in (ROOT / 'koopman_ros').iterdir()
                  if path.is_dir() and path.name != '__pycache__')
PROGRAMS = [ROOT / name for name in ('benchmarks', 'examples', 'studies')]


def odd_phrases(prose: str, odd: tuple[str, ...]) -> list[str]:
    """Return the odd phrases in a text, each with its surroundings."""
    prose = re.sub(r'\s+', ' ', prose)
    return [prose[max(0, found.start() - 30):found.end() + 30]
            for found in re.finditer(rf'(?<![.\w])(?:{"|".join(odd)})\b', prose, re.IGNORECASE)]


def prose_of(file: Path) -> Iterator[str]:
    """Yield all strings of at least three words in a module, f-strings without their values."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else '{}'
                     for part in node.values]
            text = ''.join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = re.sub(r':param \w+:|``.*?``', '', node.value)
        else:
            continue
        if len(re.findall('[A-Za-z]+', text)) >= 3:
            yield text


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_have_no_odd_words(page: Path) -> None:
    # code and quoted messages are not prose
    prose = re.sub(r'```.*?```|`[^`]*`', '', page.read_text(), flags=re.DOTALL)
    assert not odd_phrases(prose, ODD)


def test_the_help_of_the_makefile_has_no_odd_words() -> None:
    texts = re.findall('## (.*)', (ROOT / 'Makefile').read_text())
    assert len(texts) > 20
    assert not odd_phrases('\n'.join(texts), ODD_IN_CODE)


@pytest.mark.parametrize('package', [ROOT / 'koopman_ros', *PACKAGES, *PROGRAMS],
                         ids=lambda package: package.name)
def test_messages_and_docstrings_have_no_odd_words(package: Path) -> None:
    files = package.glob('*.py') if package.name == 'koopman_ros' else package.rglob('*.py')
    found = {f'{file.relative_to(ROOT)}: {phrase}' for file in files for text in prose_of(file)
             for phrase in odd_phrases(text, ODD_IN_CODE)}
    assert not found
