# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Run what README and tutorials tell a reader to type, in clones without anything installed.

`make walkthrough` runs all; `python3 test/walkthrough.py demo-retrain measured_record` some. Each
command of the README has a clone of its own, and so have its lines of Python and each tutorial,
whose blocks are run in their order. The clones hold what is committed. Blocks that need a sourced
ROS 2 are listed; the tests in `test/nodes` run what is in them.
"""

from collections.abc import Iterator
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import tempfile
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
# Run by continuous integration in the checkout itself.
ELSEWHERE = ('make test', 'make docs')
# Some images have no sudo, and need none.
SUDO = 'command -v sudo > /dev/null || sudo() { "$@"; }\n'
# Ends with Ctrl-C, once it has printed this.
LASTING, READY = 'PANEL=1', 'the panel is at'


class Block(NamedTuple):
    """A block of code of a page."""

    kind: str  #: 'sh' or 'python'
    text: str


def blocks(text: str) -> list[Block]:
    """Return the blocks of a page that a reader runs, lines of Python in a row as one program."""
    found: list[Block] = []
    for kind, block in re.findall(r'^```(sh|python)\n(.*?)^```', text, re.DOTALL | re.MULTILINE):
        if kind == 'python' and _is_excerpt(block):
            continue
        if found and kind == found[-1].kind == 'python':
            block = found.pop().text + block
        found.append(Block(kind, block))
    return found


def _is_excerpt(block: str) -> bool:
    """Tell whether lines are those of a file of the examples, which a page explains."""
    return any(block in path.read_text() for path in ROOT.glob('examples/*/*.py')
               if path.parent.name != 'tutorials')


def walks(root: Path = ROOT) -> dict[str, list[Block]]:
    """Return what is run in a clone each, by its name."""
    _, _, trying = (root / 'README.md').read_text().partition('## Try it\n')
    trying, _, python = trying.partition('## In Python\n')
    python, _, _ = python.partition('\n## ')
    commands = [line for block in blocks(trying) for line in block.text.splitlines()]
    commands += re.findall(r'^\| `(make [^`]+)`', trying, re.MULTILINE)
    found = {command.removeprefix('make '): [Block('sh', f'{command}\n')]
             for command in commands if command not in ELSEWHERE}
    found['README'] = blocks(python)
    for page in sorted(root.glob('docs/tutorials/*.md')):
        found[page.stem] = blocks(page.read_text())
    return found


def needs_ros(block: Block) -> bool:
    """Tell whether a block is for a sourced ROS 2."""
    return block.kind == 'sh' and re.search(r'^(ros2|colcon) ', block.text, re.MULTILINE
                                            ) is not None


def run(block: Block, folder: Path) -> bool:
    """Run a block in a clone; return whether it succeeded."""
    command = (['bash', '-euc', SUDO + block.text] if block.kind == 'sh'
               else ['.venv/bin/python', '-c', block.text])
    # what an environment of the caller adds is not there for a reader
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('VIRTUAL_ENV', 'PYTHONPATH', 'MAKEFLAGS', 'MAKELEVEL')}
    with subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, start_new_session=True, env=environment
            ) as process:
        assert process.stdout is not None
        interrupted, said = False, ''
        for line in process.stdout:
            print('   ', line, end='', flush=True)
            said += line
            if LASTING in block.text and READY in line and not interrupted:
                interrupted = True
                os.killpg(process.pid, signal.SIGINT)
    # make reports its interrupt as an error
    return 'Traceback' not in said if interrupted else process.returncode == 0


def walk(name: str, steps: list[Block], source: Path = ROOT) -> Iterator[str]:
    """Run blocks in a new clone, up to the first that fails; yield its complaint."""
    with tempfile.TemporaryDirectory(prefix='walkthrough_') as folder:
        clone = Path(folder) / source.name
        subprocess.run(['git', 'clone', '--quiet', str(source), str(clone)], check=True)
        for block in steps:
            if needs_ros(block):
                print(f'{name}: needs a sourced ROS 2, not run:\n{block.text}', flush=True)
                continue
            print(f'{name}: {block.text}', flush=True)
            if not run(block, clone):
                yield f'{name}: failed:\n{block.text}'
                return


def main(names: list[str]) -> int:
    """Run all, or those with these names."""
    every = walks()
    if unknown := sorted(set(names) - set(every)):
        sys.exit(f'unknown: {", ".join(unknown)}; known: {", ".join(every)}')
    failures = [complaint for name in names or every for complaint in walk(name, every[name])]
    print(*failures, f'{len(names or every)} run, {len(failures)} failed', sep='\n')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
