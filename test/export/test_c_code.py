# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest

from koopman_ros.control import Controller
from koopman_ros.core.arrays import Array
from koopman_ros.core.paths import model_path
from koopman_ros.export import c_code, ExportError
from koopman_ros.export.command_line import main
from koopman_ros.export.cortex_m4 import measured
from koopman_ros.export.vectors import vectors, with_laws
from koopman_ros.model import (
    Coordinates,
    LiftedModel,
    linearised_model,
    load,
    PolynomialObservables,
    Provenance,
)
from koopman_ros.parameters.controller import built, table_of
from koopman_ros.tuning import Tuning
from studies.exported_loops import (
    bundled_loops,
    compared,
    disagreement,
    FLAGS,
    INTERVAL,
    random_loop,
    SANITIZERS,
)

CROSS_COMPILER = ('arm-none-eabi-gcc', 'qemu-system-arm')
BUNDLED = {name: (controller, interval) for name, controller, interval in bundled_loops()}


def needs(*programs: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not all(map(shutil.which, programs)), reason=f'needs {programs}')


@pytest.mark.parametrize(('name', 'compiler', 'flags'), [
    pytest.param(name, compiler, flags, marks=needs(compiler)) for name, compiler, flags in (
        ('reactor_nz4', 'clang', ()), ('fed_reactor', 'gcc', ()), ('heated_line', 'gcc', ()),
        ('quadruple_tank', 'gcc', ()), ('two_state_example', 'gcc', SANITIZERS),
        ('two_state_saddle', 'gcc', ()))])
def test_code_of_bundled_models_gives_the_commands_and_codes_of_the_controller(
        name: str, compiler: str, flags: tuple[str, ...]) -> None:
    controller, interval = BUNDLED[name]
    found = compared(controller, 100, interval, compiler=compiler, flags=('-O0', *flags))
    assert found.error <= 1e-9
    assert found.different == ()


@needs('gcc')
def test_code_of_any_kind_of_loop_gives_the_commands_and_codes_of_the_controller() -> None:
    seen: set[tuple[str, ...]] = set()
    for seed in (0, 6, 11, 19):
        found = compared(random_loop(seed), 100, INTERVAL, flags=('-O0', *SANITIZERS))
        assert found.error <= 1e-9
        assert found.different == ()
        seen |= found.seen
    assert len({status for _, status, _ in seen}) == 10


@needs(*CROSS_COMPILER)
def test_a_cortex_m4_gives_the_same_commands(tmp_path: Path) -> None:
    controller, interval = BUNDLED['reactor_nz4']
    for name, text in c_code(controller, interval).items():
        (tmp_path / name).write_text(text)
    rows = list(vectors(controller, 40, interval))
    calls = with_laws(controller, rows, 10)
    found = measured(tmp_path, calls)
    assert found is not None
    error, different = disagreement(
        controller, [answer for _, answer in rows[:len(calls)]], found.answers)
    assert error <= 1e-9
    assert not different
    assert found.stack < 16384
    assert found.instructions > 100_000  # a law was among the calls


@needs('gcc')
def test_the_program_writes_an_example_that_repeats_its_test_vectors(tmp_path: Path) -> None:
    (tmp_path / 'loop.yaml').write_text(
        'controller: {ros__parameters: {system: two_tanks, level_1.weight: 2, '
        'fallback_order: [mpc, sdre, linear]}}')
    assert main(['two_tanks', '--parameters', str(tmp_path / 'loop.yaml'), '--sample_period',
                 '0.5', '--output', str(tmp_path)]) == 0
    # also with the extensions of a compiler's own standard
    subprocess.run(['gcc', *FLAGS[1:], tmp_path / 'controller.c', tmp_path / 'example.c', '-lm',
                    '-o', tmp_path / 'example'], check=True)
    table = (tmp_path / 'test_vectors.csv').read_text()
    answers = subprocess.run([tmp_path / 'example'], input=table, check=True,
                             capture_output=True, text=True).stdout.splitlines()
    wanted = [row.split(',')[-5:] for row in table.splitlines()[1:]]
    assert len(wanted) == 200
    error, different = disagreement(BUNDLED['two_tanks'][0], wanted, answers)
    assert error <= 1e-9
    assert not different
    readme = (tmp_path / 'README.md').read_text()
    assert '@' not in readme
    size = 'kB of stack' if all(map(shutil.which, CROSS_COMPILER)) else 'gcc-arm-none-eabi'
    assert size in readme


@pytest.mark.parametrize(('parameters', 'options', 'words'), [
    ('{tempperature.weight: 2.0}', [], 'tempperature.weight'),
    ('{temperature.weight: -2.0}', [], 'temperature.weight = -2.0'),
    ('{estimator: unscented_kalman_filter}', [], 'extended_kalman_filter'),
    ('{fallback_order: [sdre, pi]}', [], 'law pi'),
    ('{fallback_order: [linear]}', [], 'does not contain sdre'),
    ('{}', ['--sample_period', '0'], 'above 0 s')])
def test_the_export_command_rejects_unsupported_loops(
        tmp_path: Path, capsys: pytest.CaptureFixture[str], parameters: str, options: list[str],
        words: str) -> None:
    (tmp_path / 'loop.yaml').write_text(f'controller: {{ros__parameters: {parameters}}}')
    assert main(['reactor_nz4', '--parameters', str(tmp_path / 'loop.yaml'), '--output',
                 str(tmp_path / 'out'), '--sample_period', '1', *options]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_a_receding_horizon_law_and_a_high_degree_are_rejected() -> None:
    controller, _ = BUNDLED['reactor_nz4']
    with pytest.raises(ExportError, match='acados'):
        c_code(Controller(controller.model, replace(
            controller.tuning, fallback_order=('mpc', 'sdre'))), 1.0)
    states, inputs = (Coordinates.spanning(names, ('1',) * len(names), -np.ones(len(names)),
                                           np.ones(len(names)))
                      for names in (('level', 'commanded_valve'), ('valve',)))
    moved = linearised_model(np.array([[-1.0, 1.0], [0.0, -2.0]]), np.array([[0.0], [2.0]]),
                             states, inputs, 's', Provenance('tank'))
    with pytest.raises(ExportError, match='as_state'):
        c_code(Controller(moved, Tuning.for_model(moved, estimator='extended_kalman_filter')),
               1.0)
    powers = PolynomialObservables(np.array([[1], [11]]))
    model = replace(controller.model, observables=powers, A=-np.eye(2))
    with pytest.raises(ExportError, match='degree 11'):
        c_code(Controller(model, controller.tuning), 1.0)


@pytest.mark.parametrize(('model', 'given', 'words'), [
    ('reactor_nz4', {'safe_latch': True}, 'safe_latch'),
    ('reactor_nz4', {'temperature.report_on_change': 10.0}, 'report_on_change')])
def test_the_export_rejects_unsupported_features(
        model: str, given: dict[str, Any], words: str) -> None:
    learned = load(model_path(model))
    with pytest.raises(ExportError, match=words):
        c_code(built(table_of(learned).snapshot(given), learned), 1.0)


def test_a_part_of_a_model_that_the_code_does_not_know_is_rejected() -> None:
    @dataclass(frozen=True)
    class BacklashModel(LiftedModel):
        backlash: Array = field(default_factory=lambda: np.zeros(1))

    controller, _ = BUNDLED['reactor_nz4']
    given = {one.name: getattr(controller.model, one.name) for one in fields(LiftedModel)}
    for backlash in (0.0, 0.1):
        loop = Controller(BacklashModel(**given, backlash=np.array([backlash])), controller.tuning)
        if backlash:
            with pytest.raises(ExportError, match='model_backlash'):
                c_code(loop, 1.0)
        else:
            assert c_code(loop, 1.0)
