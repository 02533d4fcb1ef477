# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
import re
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest

from koopman_ros.control import Controller, State
from koopman_ros.core.arrays import Array
from koopman_ros.core.paths import model_path
from koopman_ros.export import c_code, compiled, export_c, ExportError
from koopman_ros.export.command_line import loop, main
from koopman_ros.export.cortex_m4 import measured, OPTIMISATIONS
from koopman_ros.export.vectors import answer_row, answered, Call, vectors, with_laws
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
from studies.hostile_calls import compared_hostile

ROOT = Path(__file__).resolve().parents[2]
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


@needs('gcc')
@pytest.mark.parametrize('name', ['heated_line', 'quadruple_tank', 'two_state'])
def test_calls_that_no_plant_makes_get_the_answers_of_the_controller(
        tmp_path: Path, name: str) -> None:
    controller, interval = BUNDLED[name]
    program = compiled(c_code(controller, interval), tmp_path, 'gcc', (*FLAGS, *SANITIZERS))
    for seed in range(2):
        error, different = compared_hostile(controller, program, 80, interval, seed)
        assert error <= 1e-9
        assert different == ()


@needs('gcc')
def test_the_rate_limit_holds_from_the_first_command(tmp_path: Path) -> None:
    controller, _ = BUNDLED['reactor_nz4']
    limits = replace(controller.tuning.limits, rate=np.array([1.0]))
    controller = Controller(controller.model, replace(controller.tuning, limits=limits))
    program = compiled(c_code(controller, 1.0), tmp_path, 'gcc', FLAGS)
    rows = [Call(10**9, None if k < 2 else np.array([324.5]), np.full(1, np.nan),
                 np.full(1, np.nan), np.zeros(0)) for k in range(5)]
    commands = [float(line.split(',')[0]) for line in answers_of(program, controller, rows)]
    assert commands[0] == controller.safe_input[0]
    assert np.max(np.abs(np.diff(commands))) <= 1.0 + 1e-12
    assert commands[-1] != commands[0]


@needs('gcc')
def test_any_elapsed_time_is_defined(tmp_path: Path) -> None:
    controller, _ = BUNDLED['heated_line']
    program = compiled(c_code(controller, 1.0), tmp_path, 'gcc', (*FLAGS, *SANITIZERS))
    longest = 2**63 - 1
    rows = [Call(elapsed, np.array([323.0]), np.full(1, np.nan), np.full(1, np.nan),
                 np.full(1, np.nan))
            for elapsed in (10**9, longest, longest, -longest - 1, 10**9, 1, longest, 0, 10**9)]
    answers = answers_of(program, controller, rows)
    assert len(answers) == len(rows)
    # after such a time the loop goes on
    assert answers[-1].split(',')[1] == '0'


@needs('gcc')
@pytest.mark.filterwarnings('ignore:measurements are')
def test_commands_a_nanosecond_apart_are_those_of_the_controller(tmp_path: Path) -> None:
    controller, interval = BUNDLED['two_tanks']
    program = compiled(c_code(controller, interval), tmp_path, 'gcc', FLAGS)
    center = controller.model.states.center
    rows = [Call(1, center + 0.001 * k, center, np.full(2, np.nan), np.zeros(0))
            for k in range(6)]
    state, now_ns, wanted = State(), 10**9, []
    for call in rows:
        now_ns += call.elapsed_ns
        state, command, report = answered(controller, state, call, now_ns)
        wanted.append(answer_row(command, report))
    error, different = disagreement(controller, wanted, answers_of(program, controller, rows))
    assert error <= 1e-9
    assert not different
    assert wanted[-1][-3] == '0'


def answers_of(program: Path, controller: Controller, calls: Sequence[Call]) -> list[str]:
    text = ''.join(f'{",".join(call.row(controller))}\n' for call in calls)
    return subprocess.run([program], input=text, check=True, capture_output=True,
                          text=True).stdout.splitlines()


TWO_LOOPS = """
#include "tank_1.h"
#include "pole.h"
#include <stdio.h>
int main(void) {
    static tank_1_state tank;
    static pole_state pole;
    static tank_1_inputs from_tank;
    static pole_inputs from_pole;
    static tank_1_outputs to_tank;
    static pole_outputs to_pole;
    const double applied[TANK_1_NU] = {1.0, 2.0};
    tank_1_init(&tank, applied);
    pole_init(&pole, NULL);
    tank_1_step(&tank, &from_tank, &to_tank);
    pole_step(&pole, &from_pole, &to_pole);
    printf("%d %d %d %d %g %g %g %d", TANK_1_NX, TANK_1_NU, POLE_NX, POLE_NU, to_tank.command[0],
           to_tank.command[1], to_pole.command[0], to_pole.level == POLE_HOLD);
    return 0;
}
"""


@pytest.mark.parametrize(('compiler', 'flags', 'suffix'), [
    pytest.param('gcc', ('-std=c99',), 'c', marks=needs('gcc')),
    pytest.param('g++', ('-std=c++11',), 'cpp', marks=needs('g++')),
    # the code itself as C++, too
    pytest.param('g++', ('-std=c++11', '-x', 'c++'), 'cpp', marks=needs('g++'))])
def test_two_loops_fit_in_one_program(
        tmp_path: Path, compiler: str, flags: tuple[str, ...], suffix: str) -> None:
    program, objects = tmp_path / f'two.{suffix}', []
    program.write_text(TWO_LOOPS)
    for name, plant in (('tank_1', 'two_tanks'), ('pole', 'pendulum')):
        for file, text in c_code(*BUNDLED[plant], name=name).items():
            (tmp_path / file).write_text(text)
        objects.append(tmp_path / f'{name}.o')
        as_cpp = '-x' in flags
        subprocess.run([compiler if as_cpp else 'gcc', *(flags if as_cpp else ('-std=c99',)),
                        '-Wall', '-Wextra', '-Werror', '-c', tmp_path / f'{name}.c', '-o',
                        objects[-1]], check=True)
    subprocess.run([compiler, flags[0], '-Wall', '-Wextra', '-Werror', program, *objects, '-lm',
                    '-o', tmp_path / 'two'], check=True)
    out = subprocess.run([tmp_path / 'two'], check=True, capture_output=True, text=True).stdout
    safe = BUNDLED['pendulum'][0].safe_input[0]
    assert out.split() == ['2', '2', '2', '1', '1', '2', f'{safe:g}', '1']


@needs('gcc')
def test_no_name_of_a_loop_is_without_its_prefix(tmp_path: Path) -> None:
    code = c_code(*BUNDLED['two_tanks'], name='tank_1')
    assert set(code) == {'tank_1.h', 'tank_1.c', 'test_vectors.c', 'timer_loop.c'}
    assert not re.search(r'controller_|CONTROLLER_', ''.join(code.values()))
    (tmp_path / 'tank_1.h').write_text(code['tank_1.h'])
    (tmp_path / 'tank_1.c').write_text(code['tank_1.c'])
    subprocess.run(['gcc', '-c', 'tank_1.c'], check=True, cwd=tmp_path)
    seen = subprocess.run(['nm', '-g', '--defined-only', 'tank_1.o'], check=True, cwd=tmp_path,
                          capture_output=True, text=True).stdout
    assert {line.split()[-1] for line in seen.splitlines()} == {
        'tank_1_init', 'tank_1_step', 'tank_1_safe_input'}
    for name in ('Tank', '1tank', 'tank-1', ''):
        with pytest.raises(ExportError, match='tank_1'):
            c_code(*BUNDLED['two_tanks'], name=name)


@needs('gcc')
def test_the_code_refuses_options_under_which_nan_has_no_meaning(tmp_path: Path) -> None:
    for file, text in c_code(*BUNDLED['two_tanks']).items():
        (tmp_path / file).write_text(text)
    found = subprocess.run(['gcc', '-ffast-math', '-c', 'controller.c'], cwd=tmp_path,
                           capture_output=True, text=True)
    assert found.returncode != 0
    assert '#error' in found.stderr


def test_the_code_has_only_what_a_loop_uses() -> None:
    code = c_code(*BUNDLED['reactor_nz4'])
    for word in ('KALMAN', 'disturbance[', 'monomial', 'CURVE_', ' P[CONTROLLER'):
        assert word not in code['controller.c'] + code['controller.h']
    for text in (code['controller.c'], code['controller.h']):
        assert max(map(len, text.splitlines())) <= 99
        assert not re.search(r'@\w+@', text)


@needs('cppcheck')
@pytest.mark.parametrize('name', ['heated_line', 'quadruple_tank', 'reactor_nz4'])
def test_cppcheck_finds_nothing_but_the_deviations_of_the_page(
        tmp_path: Path, name: str) -> None:
    for file, text in c_code(*BUNDLED[name]).items():
        (tmp_path / file).write_text(text)

    def found(*options: str) -> list[str]:
        return subprocess.run(
            ['cppcheck', '--std=c99', '--quiet', '--template={id}', *options], cwd=tmp_path,
            check=True, capture_output=True, text=True).stderr.split()

    assert not found('--enable=warning,style,performance,portability', '.')
    page = (ROOT / 'docs/how-to/export.md').read_text()
    listed = set(re.findall(r'\b\d+\.\d+\b', page[page.index('MISRA'):]))
    rules = {one.removeprefix('misra-c2012-') for one in found('--addon=misra', 'controller.c')
             if one.startswith('misra')}
    assert rules
    assert rules <= listed


@needs('gcc')
def test_the_example_in_a_timer_loop_runs(tmp_path: Path) -> None:
    controller, interval = BUNDLED['quadruple_tank']
    program = compiled(c_code(controller, interval), tmp_path, 'gcc', (*FLAGS, *SANITIZERS),
                       'timer_loop.c')
    out = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    level = {int(period): int(number) for period, number in re.findall(
        r'(\d+): level (\d+)', out)}
    hold = len(controller.levels)
    # started without a sample, two samples missing, manual mode, and on
    assert [level[period] for period in (1, 2, 6, 7, 9, 10, 11)] == [
        hold, 0, 0, 0, hold, hold, 0]
    assert set(range(1, 21)) - set(level) == {13, 14, 15}
    assert level[16] == level[20] == 0


@needs('gcc')
@pytest.mark.parametrize('row', [
    '1000000000,1,324.5,nan', '1000000000,1,324.5,nan,nan,', '1000000000,1,x,nan,nan',
    '1e9,1,324.5,nan,nan', '99999999999999999999,1,324.5,nan,nan', '1000000000,1,324.5,,nan',
    '1000000000,1,324.5,nan,nan,1,2', '1000000000,1,324.5 K,nan,nan', '', 'hello'])
def test_the_test_of_vectors_refuses_bad_text(vector_program: Path, row: str) -> None:
    good = '1000000000,1,324.5,nan,nan\n'
    ran = subprocess.run([vector_program], input=f'{good}{row}\n{good}', capture_output=True,
                         text=True)
    assert ran.returncode == 2
    assert 'row 2' in ran.stderr
    assert len(ran.stdout.splitlines()) == 1


@pytest.fixture(scope='module')
def vector_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(c_code(*BUNDLED['reactor_nz4']), tmp_path_factory.mktemp('vectors'), 'gcc',
                    FLAGS)


@needs(*CROSS_COMPILER)
@pytest.mark.parametrize('optimisation', OPTIMISATIONS)
def test_a_cortex_m4_gives_the_same_commands(tmp_path: Path, optimisation: str) -> None:
    controller, interval = BUNDLED['reactor_nz4']
    for name, text in c_code(controller, interval, 'loop_1').items():
        (tmp_path / name).write_text(text)
    rows = list(vectors(controller, 40, interval))
    calls = with_laws(controller, rows, 10)
    found = measured(tmp_path, 'loop_1', calls, optimisation)
    assert found is not None
    error, different = disagreement(
        controller, [answer for _, answer in rows[:len(calls)]], found.answers)
    assert error <= 1e-9
    assert not different
    assert found.stack < 8192
    assert found.instructions > 100_000  # a law was among the calls


@needs('gcc')
def test_command_and_function_write_the_same_folder_with_its_test(tmp_path: Path) -> None:
    (tmp_path / 'loop.yaml').write_text(
        '/**/controller: {ros__parameters: {system: two_tanks, level_1.weight: 2.0, '
        'fallback_order: [mpc, sdre, linear]}}')
    assert main(['two_tanks', '--parameters', str(tmp_path / 'loop.yaml'), '--sample_period',
                 '0.5', '--name', 'tanks', '--output', str(tmp_path / 'command')]) == 0
    controller = loop('two_tanks', 'sdre', tmp_path / 'loop.yaml')
    export_c(controller, tmp_path / 'python', name='tanks', sample_period=0.5)
    assert files_of(tmp_path / 'command') == files_of(tmp_path / 'python')
    # also with the extensions of a compiler's own standard
    folder = tmp_path / 'command'
    subprocess.run(['gcc', *FLAGS[1:], folder / 'tanks.c', folder / 'test_vectors.c', '-lm',
                    '-o', folder / 'test'], check=True)
    table = (folder / 'test_vectors.csv').read_text()
    ran = subprocess.run([folder / 'test'], input=table, check=True, capture_output=True,
                         text=True)
    wanted = [row.split(',')[-5:] for row in table.splitlines()[1:]]
    assert len(wanted) == 200
    error, different = disagreement(controller, wanted, ran.stdout.splitlines())
    assert error <= 1e-9
    assert not different
    assert '200 calls compared, 0 differ' in ran.stderr
    wrong = table.replace(',' + ','.join(wanted[7]) + '\n', ',9' + ','.join(wanted[7]) + '\n')
    assert subprocess.run([folder / 'test'], input=wrong, capture_output=True,
                          text=True).returncode == 1
    readme = (folder / 'README.md').read_text()
    assert '@' not in readme
    size = '| `-Os` |' if all(map(shutil.which, CROSS_COMPILER)) else 'gcc-arm-none-eabi'
    assert size in readme


def files_of(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


@pytest.mark.parametrize('name', ['heated_line', 'quadruple_tank', 'reactor_nz4', 'pendulum'])
def test_a_tuning_by_default_is_that_of_the_controller_node(tmp_path: Path, name: str) -> None:
    model = load(model_path(name))
    period = model.sample_interval
    code = without_ranges(Controller(model, Tuning.for_model(model)), period)
    (tmp_path / 'loop.yaml').write_text('/**/controller: {ros__parameters: {system: ""}}')
    assert without_ranges(loop(name, 'sdre', tmp_path / 'loop.yaml'), period) == code
    assert without_ranges(loop(name, 'sdre'), period) == code


def without_ranges(controller: Controller, period: float) -> str:
    """Return the code without the ranges of sensors: absent ones are numbers in °C or K."""
    return re.sub(r'(SENSOR|DISTURBANCES)_(LOWER|UPPER)\[\] = .*', '', c_code(
        controller, period)['controller.c'])


def test_what_the_record_measured_is_measured_by_default() -> None:
    model = load(model_path('heated_line'))
    partly = replace(model, states_measured=('temperature',))
    code = c_code(Controller(partly, Tuning.for_model(partly)), 1.0)
    assert '#define CONTROLLER_NY 1' in code['controller.h']


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
    (tmp_path / 'loop.yaml').write_text(f'/**/controller: {{ros__parameters: {parameters}}}')
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
