# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The examples run, and as their pages say."""

from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest

from koopman_ros.lifting import load
from support.disturbance import script

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / 'examples' / 'own_plant.py'
# half a minute of computing, several of them beside other programs
pytestmark = pytest.mark.timeout(600)
# Columns of the table that the example prints.
ROLL_OUT, COST, OFFSET = 3, 4, 5


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Run the example as a user does; return what it prints and the file it leaves."""
    folder = tmp_path_factory.mktemp('example')
    done = subprocess.run(script(EXAMPLE), cwd=folder, capture_output=True, text=True,
                          timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, folder / 'two_tanks.safetensors'


def _table(text: str) -> dict[str, list[float]]:
    """Return the rows that start with the name of a model, whose last six words are numbers."""
    rows = (line.split() for line in text.splitlines()
            if re.match(r'(linearised|EDMD|lift|free)\b', line))
    return {' '.join(row[:-6]): [float(word) for word in row[-6:]] for row in rows}


def test_example_learns_controls_better_than_linear_and_leaves_it(run: tuple[str, Path]) -> None:
    rows = _table(run[0])
    assert list(rows) == ['linearised', 'EDMD, degree 3', 'EDMD, degree 5', 'lift, n_z = 3',
                          'lift, n_z = 4', 'lift, n_z = 5', 'free, n_z = 2']
    lift, free = rows['lift, n_z = 5'], rows['free, n_z = 2']
    linear, cubic, quintic = (
        rows[name] for name in ('linearised', 'EDMD, degree 3', 'EDMD, degree 5'))
    assert quintic[ROLL_OUT] < 0.2 < 1.0 < cubic[ROLL_OUT] < 1.5 < linear[ROLL_OUT]
    # what the page says of which is closer: the free lift than any, a quintic than the others
    assert free[ROLL_OUT] < quintic[ROLL_OUT] < lift[ROLL_OUT] < 3.0
    assert max(lift[COST], free[COST], quintic[COST], cubic[COST]) < 9.7 < linear[COST]
    # derived by hand: the linear feed-forward is 20 (1 + (0.3 - 1) / 2) = 13 L/min against
    # 20 sqrt(0.3) = 10.95; alone it ends at 0.4225 m, and feedback corrects part of that
    assert max(lift[OFFSET], free[OFFSET], quintic[OFFSET]) < 3.0
    assert cubic[OFFSET] < 5.0 < linear[OFFSET] < 122.5
    model = load(run[1])
    assert (model.provenance.plant, model.n_z) == ('two tanks', 2)
    # derived by hand: the slopes of both outflows at 1 m, 10 L/min/m over the areas
    np.testing.assert_allclose(model.eigenvalues, [-10.0 / 140.0, -10.0 / 100.0], rtol=1e-3)


def test_page_shows_the_example_and_what_it_prints(run: tuple[str, Path]) -> None:
    _, _, page = (ROOT / 'docs' / 'own_plant.md').read_text().partition('## From Python')
    source = EXAMPLE.read_text()
    # one with dots is a sketch of what the example does not do
    blocks = [block for block in re.findall(r'```python\n(.*?)```', page, re.DOTALL)
              if '...' not in block]
    assert len(blocks) == 5
    for block in blocks:
        assert block in source
    shown, found = _table(page), _table(run[0])
    assert list(shown) == list(found)
    # what is not learned is the same wherever it runs
    for name in ('linearised', 'EDMD, degree 3', 'EDMD, degree 5'):
        np.testing.assert_allclose(shown[name], found[name], rtol=0.05)


def test_example_of_the_readme_brings_the_reactor_to_its_set_point(tmp_path: Path) -> None:
    (block,) = re.findall(r'```python\n(.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL)
    # about twenty lines, as a reader counts them
    assert len(block.splitlines()) < 30
    file = tmp_path / 'step.py'
    file.write_text(f'{block}\nprint(run.states[-1, 0])\n')
    (tmp_path / 'config').symlink_to(ROOT / 'config')
    done = subprocess.run([sys.executable, str(file)], cwd=tmp_path, capture_output=True,
                          text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    # derived from the balance: the steady state is 324.475443 K, the step 10 K down; what is left
    # after five minutes is the error of the model
    assert float(done.stdout) == pytest.approx(314.475443, abs=1e-3)
    assert (tmp_path / 'step.png').read_bytes().startswith(b'\x89PNG')
