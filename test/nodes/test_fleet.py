# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The trainer as a program that trains the plants of many loops in one call."""

from pathlib import Path

import pytest
import yaml

from koopman_ros.model import load
from koopman_ros.nodes import trainer
from koopman_ros.testing import Harness
from support.nodes import run_here
from support.recorded_runs import linear_run, write_bag


def arguments(folder: Path, bags: dict[str, list[str]], **everywhere: object) -> tuple[str, ...]:
    """Return those of a fleet, with the bags of each by its namespace."""
    (folder / 'loops.txt').write_text('\n'.join(['# all of them', *bags]))
    loops = {f'/{name}/trainer': {'ros__parameters': {
        'bags': own, 'model_output': str(folder / f'{name}.safetensors')}}
        for name, own in bags.items()}
    (folder / 'site.yaml').write_text(yaml.safe_dump({'/**': {'ros__parameters': {
        'system': 'reactor', 'model': '', 'model_class': 'linear',
        'identification_methods': ['weak_form'], 'weak_form.windows': [20.0],
        'temperature.topic': '/temperature',
        'coolant_temperature.command_topic': '/coolant_setpoint', **everywhere}}, **loops}))
    return ('--params-file', str(folder / 'site.yaml'), '--', '--loops',
            str(folder / 'loops.txt'))


def test_each_plant_has_its_own_progress(ros: Harness, tmp_path: Path) -> None:
    bag = str(write_bag(tmp_path / 'run.mcap', linear_run(400)))
    program = ros.start('trainer', arguments=arguments(
        tmp_path, {'a': [bag], 'lost': [str(tmp_path / 'none.mcap')], 'bare': ['']}))
    # one of them could not be trained
    assert program.wait(120.0) == 1, program.output()
    lines = dict(line.split(': ', 1) for line in program.output().splitlines() if ': ' in line)
    assert 'is accepted' in lines['/a']
    assert lines['/lost'] == (
        f"training failed: bag '{tmp_path}/none.mcap' does not exist: check the path")
    assert lines['/bare'] == 'cannot be retrained: no bag to train from: set bags'
    assert lines['trainer'] == '1 of 2 new models are accepted'
    assert load(tmp_path / 'a.safetensors').states.names == ('temperature',)
    assert not (tmp_path / 'lost.safetensors').exists()


def test_plants_of_one_call_are_trained_in_one_place(
        tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    given = arguments(tmp_path, {'a': ['a.mcap'], 'b': ['b.mcap']})
    site = yaml.safe_load((tmp_path / 'site.yaml').read_text())
    site['/b/trainer']['ros__parameters']['executor'] = 'joblib:2'
    (tmp_path / 'site.yaml').write_text(yaml.safe_dump(site))
    assert run_here(trainer, *given) == 1
    assert "executor is '' and 'joblib:2' in different loops" in ''.join(capfd.readouterr())
