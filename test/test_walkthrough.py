# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The walkthrough finds what a reader types, and notices what fails in a clone."""

from pathlib import Path
import subprocess

import pytest

from walkthrough import Block, blocks, ROOT, walk, walks


def test_all_commands_and_pages_are_walked() -> None:
    found = walks()
    assert {'demo', 'demo-retrain', 'demo-saddle SEEDS=1', 'README'} <= set(found)
    assert {page.stem for page in ROOT.glob('docs/tutorials/*.md')} <= set(found)
    assert not {'test', 'docs'} & set(found)
    assert [block.kind for block in found['without_ros']] == ['sh', 'python', 'sh']
    # the set-up stands before the code
    for name in ('README', 'without_ros', 'measured_record', 'python_scripts', 'see_it_run'):
        assert 'make ' in found[name][0].text, name


def test_lines_in_a_row_are_one_program_and_excerpts_of_files_are_none() -> None:
    page = ('```sh\nmake learn\n```\n```python\na = 1\n```\nIt prints\n```text\n1\n```\n'
            '```python\nprint(a)\n```\n```python\n'
            "    entry_points={'koopman_ros.plants': ['oven = oven:Oven']},\n```\n")
    assert blocks(page) == [Block('sh', 'make learn\n'), Block('python', 'a = 1\nprint(a)\n')]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a repository with one committed file."""
    folder = tmp_path / 'tree'
    folder.mkdir()
    (folder / 'there').write_text('')
    for command in (['init', '--quiet'], ['add', 'there'], [
            '-c', 'user.name=test', '-c', 'user.email=test@test.invalid', 'commit', '--quiet',
            '--message', 'Begin']):
        subprocess.run(['git', *command], cwd=folder, check=True)
    (folder / 'forgotten').write_text('')
    return folder


@pytest.mark.parametrize(('steps', 'failing'), [
    (['cat there', 'touch made', 'cat made'], []),
    (['cat there', 'cat forgotten', 'touch made'], ['cat forgotten']),
    (['ros2 topic list', 'cat there'], []),
    (['false\ntrue'], ['false']),
])
def test_what_is_not_in_a_clone_is_a_failure(
        tree: Path, steps: list[str], failing: list[str]) -> None:
    complaints = list(walk('page', [Block('sh', f'{text}\n') for text in steps], tree))
    assert len(complaints) == len(failing)
    for complaint, text in zip(complaints, failing, strict=True):
        assert text in complaint
    assert not (tree / 'made').exists()


@pytest.mark.parametrize(('ending', 'failures'), [('pass', 0), ('raise', 1)])
def test_what_runs_until_ctrl_c_gets_it(tree: Path, ending: str, failures: int) -> None:
    program = ("import time\ntry:\n    print('the panel is at http://here', flush=True)\n"
               f'    time.sleep(600)\nexcept KeyboardInterrupt:\n    {ending}\n')
    block = Block('sh', f"PANEL=1 python3 - <<'END'\n{program}END\n")
    assert len(list(walk('page', [block], tree))) == failures
