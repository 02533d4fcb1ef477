# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Each target of the Makefile installs all that it runs, in a clone without `.venv`."""

from pathlib import Path
import re
import shutil
import subprocess

import pytest

from support.distributions import imports_of, installed_with, modules_of_this_tree, providers

ROOT = Path(__file__).parent.parent
MAKEFILE = (ROOT / 'Makefile').read_text()
TARGETS = re.findall(r'^([a-z-]+):.*##', MAKEFILE, re.MULTILINE)
VARIANTS = ('demo PANEL=1', 'demo PLANT=pendulum', 'demo EXPORT=1', 'demo DISTURBANCE=1',
            'test-machines MACHINES=--quick', 'bench BENCH=--quick', 'faults FAULTS=--quick')
NODES = tuple(f'koopman_ros.nodes.{name}' for name in ('plant', 'controller', 'trainer'))
# What a target starts as processes of their own, or loads by its name.
STARTS = {
    'demo': NODES, 'demo EXPORT=1': ('studies.exported_loops',), 'demo-retrain': (
        'koopman_ros.learning',), 'demo PANEL=1': ('koopman_ros.panel.server',),
    'faults': (*NODES, 'koopman_ros.control.mpc.planner'),
    'studies-saddle': ('koopman_ros.control.mpc.planner',),
    'demo-saddle': ('koopman_ros.control.mpc.planner',)}


def dry_run(target: str, folder: Path) -> str:
    """Return the commands of a target where nothing is installed yet."""
    for name in ('Makefile', 'setup.py', 'requirements.lock'):
        shutil.copy(ROOT / name, folder)
    return subprocess.run(['make', '--dry-run', *target.split()], cwd=folder, text=True,
                          capture_output=True, check=True).stdout.replace('\\\n', ' ')


def missing(commands: str, started: tuple[str, ...] = ()) -> dict[str, str]:
    """Return what commands run or import without that it was installed, each with its place."""
    extras = ','.join(re.findall(r"--editable '\.\[([\w,]+)\]'", commands))
    there = installed_with(*([f'koopman_ros[{extras}]'] if extras else []), 'pip') | set(
        re.findall(r'pip install (?:--quiet |--no-deps )*([a-z]+)', commands))
    programs = re.findall(r'\.venv/bin/(?:python -m )?([\w.]+)', commands)
    scripts = re.findall(r'\.venv/bin/python ([\w/]+)\.py', commands)
    wanted = {}
    for name in (*programs, *(script.replace('/', '.') for script in scripts), *started):
        if name.split('.')[0] == 'python':
            continue
        if own := modules_of_this_tree(name):
            wanted |= imports_of(*own)
        else:
            wanted[name.split('.')[0]] = 'Makefile'
    # one that is not installed here has the name of its distribution
    return {module: place for module, place in wanted.items()
            if not providers().get(module, {module}) & there}


@pytest.mark.parametrize('target', [*TARGETS, *VARIANTS])
def test_a_target_installs_what_it_runs(target: str, tmp_path: Path) -> None:
    started = STARTS.get(target.split()[0], ()) + STARTS.get(target, ())
    assert not missing(dry_run(target, tmp_path), started)


def test_a_target_without_a_package_is_found() -> None:
    install = ".venv/bin/python -m pip install --quiet --editable '.[ros,demo,{}]'\n"
    run = '.venv/bin/python -m studies.saddle --seeds 1'
    assert missing(install.format('train') + run).keys() >= {'casadi'}
    assert not missing(install.format('train,bench') + run)
    assert missing('.venv/bin/ruff check') == {'ruff': 'Makefile'}
