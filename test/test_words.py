# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The pages use plain technical English: none of a list of odd words and phrases."""

from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted(ROOT.glob('docs/**/*.md'))]
ODD = '|'.join((
    'anew', 'afresh', 'asked for', 'beside', 'besides', 'goes by', 'go by', 'is told', 'are told',
    'tells? of', r'is said', 'are said', 'whoever', 'whose turn', 'somebody', 'nobody',
    "one's own", 'of before', 'what acts', 'what is', 'what was', 'what are', 'to the bit',
    'by itself alone', 'by hand', 'where it is not said', 'stands? still', 'must hold to',
    'is heard', 'hears', 'likewise', 'as it stands', 'far astray', 'leads? back', 'let go'))


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_have_no_odd_words(page: Path) -> None:
    # code and quoted messages are not prose
    prose = re.sub(r'```.*?```|`[^`]*`', '', page.read_text(), flags=re.DOTALL)
    prose = re.sub(r'\s+', ' ', prose)
    assert not [prose[max(0, found.start() - 30):found.end() + 30]
                for found in re.finditer(rf'\b(?:{ODD})\b', prose, re.IGNORECASE)]
