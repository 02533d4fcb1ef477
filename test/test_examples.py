# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The tutorials and the example of the README run, and what they say is true."""

from contextlib import redirect_stdout
from dataclasses import dataclass
import io
from pathlib import Path
import re
import runpy
import shlex
import shutil
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from sensor_msgs.msg import JointState

from koopman_ros.core.units import NANOSECONDS
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.testing import Harness
from support.nodes import ros, type_support
from support.tanks import LEVELS, PUMPS, TANKS

__all__ = ['ros', 'type_support']

ROOT = Path(__file__).parent.parent
TUTORIALS = ROOT / 'examples' / 'tutorials'
PNG = b'\x89PNG'


@dataclass(frozen=True)
class Run:
    """What a tutorial left behind."""

    names: dict[str, Any]  #: its variables
    text: str  #: what it printed
    folder: Path  #: where its files are
    labels: list[str]  #: of the axes of all its pictures


def _run(name: str, folder: Path, *arguments: str) -> Run:
    """Run a tutorial in a folder, in this process, which has imported the most of it."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, 'argv', [f'{name}.py', *arguments])
        matplotlib.use('Agg')
        with redirect_stdout(said):
            names = runpy.run_path(str(TUTORIALS / f'{name}.py'), run_name='__main__')
        plt = names['plt']
        labels = [label for number in plt.get_fignums() for axes in plt.figure(number).axes
                  for label in (axes.get_xlabel(), axes.get_ylabel()) if label]
        plt.close('all')
    return Run(names, said.getvalue(), folder, labels)


@pytest.fixture(scope='module')
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return _run('pendulum', tmp_path_factory.mktemp('pendulum'))


@pytest.fixture(scope='module')
def tanks(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return _run('two_tanks', tmp_path_factory.mktemp('tanks'), 'results')


@pytest.fixture(scope='module')
def beam(tmp_path_factory: pytest.TempPathFactory) -> Run:
    # the arguments of a notebook's kernel
    return _run('buckled_beam', tmp_path_factory.mktemp('beam'), '-f', 'kernel.json')


def _numbers(pattern: str, text: str) -> list[float]:
    """Return the numbers that a pattern finds in the one line that it fits."""
    (found,) = re.findall(pattern, text, re.MULTILINE)
    return [float(word) for word in (found if isinstance(found, tuple) else (found,))]


@pytest.mark.parametrize(('name', 'files'), [
    ('pendulum', ('out/tutorials/pendulum_samples.png', 'out/tutorials/pendulum_loop.png')),
    ('tanks', ('results/two_tanks_record.png', 'results/two_tanks_loop.png')),
    ('beam', ('out/tutorials/buckled_beam.png',))])
def test_pictures_are_written_to_the_given_folder_with_units(
        name: str, files: tuple[str, ...], request: pytest.FixtureRequest) -> None:
    run = request.getfixturevalue(name)
    for file in files:
        assert (run.folder / file).read_bytes().startswith(PNG)
    assert len(run.labels) >= 4
    for label in run.labels:
        assert re.search(r' \[(s|min|rad|rad/s|N|N m|m|V|mm|mm/s)\]$', label), label


def test_classes_on_the_pendulum_differ_and_the_rule_is_as_stated(pendulum: Run) -> None:
    found, by_hand = pendulum.names['found'], pendulum.names['by_hand']
    rows = {one.name: one for one in found.contenders}
    assert list(rows) == ['linear', 'polynomial', 'neural drift', 'identity lift', 'free lift']
    assert found.chosen is by_hand
    assert str(found) in pendulum.text
    # sin a is smooth, and no polynomial: each class is closer than the one before
    linear, polynomial, network = (
        rows[name].figures.fit.rx for name in ('linear', 'polynomial', 'neural drift'))
    assert network < 0.3 * polynomial < 1e-3 * linear
    assert found.chosen.name not in ('linear', 'polynomial')
    assert pendulum.names['worst'] < 1e-9
    # derived by hand: the roots of s^2 + b/(m l^2) s - g/l
    roots = np.sort(np.roots([1.0, 0.1 / 0.25, -9.81 / 0.5]))
    np.testing.assert_allclose(pendulum.names['modes'], roots, rtol=1e-12)
    assert _numbers(r'modes are (\S+)/s and (\S+)/s', pendulum.text) == pytest.approx(
        roots, abs=0.005)


def test_weaker_motors_reach_less(pendulum: Run) -> None:
    checks = pendulum.names['checks']
    assert list(checks) == [4.0, 2.0]
    for torque, check in checks.items():
        # the model is as good as the truth that it is tried on
        assert check.loops > 0
        assert not check.failed.any()
        angles = np.abs(check.setpoints[:, 0])
        # derived by hand: m g l = 1 kg * 9.81 m/s^2 * 0.5 m
        assert 0.5 < 4.905 * np.sin(angles.max()) <= torque * (1.0 + 1e-6)
        assert _numbers(rf'^ *{torque:.0f} N m: .* holds (\S+) degrees', pendulum.text) == [
            pytest.approx(np.degrees(np.arcsin(torque / 4.905)), abs=0.05)]
    assert checks[2.0].hopeless > checks[4.0].hopeless > 0


def test_pendulum_is_held_where_the_linear_model_is_off(pendulum: Run) -> None:
    runs, held = pendulum.names['runs'], pendulum.names['held']
    goal, truth = 0.7, -4.905 * np.sin(0.7)
    linear, chosen = runs.values()
    for run in (linear, chosen):
        assert run.failure == ''
        assert set(run.levels) == {'sdre'}
        assert np.max(np.abs(run.commands)) == pytest.approx(5.0)  # the limit of the motor
        # at rest the torque balances gravity, wherever that is
        assert run.commands[-1, 0] == pytest.approx(-4.905 * np.sin(run.states[-1, 0]), abs=1e-2)
    assert abs(chosen.states[-1, 0] - goal) < 1e-4
    assert list(held.values())[1] == pytest.approx(truth, abs=1e-3)
    # sin a is less than its slope times a: the linear model goes too far
    assert linear.states[-1, 0] - goal > 5e-3
    assert abs(held['linear'] - truth) > 0.1
    assert _numbers(r'^linear +takes \S+ N m and ends (\S+) rad', pendulum.text) == [
        pytest.approx(linear.states[-1, 0] - goal, abs=1e-5)]


def test_tanks_are_identified_from_their_file(tanks: Run) -> None:
    names = tanks.names
    lines = (tanks.folder / 'results' / 'two_tanks.csv').read_text().splitlines()
    assert lines[0] == 'time [s],level_1 [m],level_2 [m],pump_1 [V],pump_2 [V]'
    assert len(lines) == 401
    found, decision = names['found'], names['decision']
    np.testing.assert_allclose(found.noise, 5e-4, rtol=0.5)
    np.testing.assert_allclose(found.drift.input_matrix, TANKS.B, atol=0.02 * TANKS.B[0, 0])
    assert decision.accepted
    # little but the noise is left of the lift's error
    assert np.all(decision.rmse < 2.0 * names['NOISE'])
    assert np.all(decision.linear_rmse > 2.0 * decision.rmse)
    assert np.all(names['astray'] < 1.5e-3)


def test_model_file_of_the_tanks_is_the_model(tanks: Run) -> None:
    model, trained = tanks.names['model'], tanks.names['trained'].model
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    np.testing.assert_array_equal(model.drift(x), trained.drift(x))
    # the middle of the record is a steady state of the true tanks, too, but for the model's error
    rate = TANKS.derivative(model.states.center, model.inputs.center)
    assert np.all(np.abs(rate) < 0.1 * TANKS.B[0, 0])  # worth 0.1 V


def test_unreachable_set_point_of_the_tanks_is_rejected_as_the_truth_has_it(tanks: Run) -> None:
    # derived by hand: both outlets are alike, so that k u2 = a sqrt(2 g) (sqrt(h2) - sqrt(h1))
    u1, u2 = 0.1781e-4 * np.sqrt(2.0 * 9.81) / 3.3e-6 * np.array(
        [np.sqrt(0.15), np.sqrt(0.08) - np.sqrt(0.15)])
    assert _numbers(r'in truth it takes (\S+) V and (\S+) V', tanks.text) == pytest.approx(
        [u1, u2], abs=0.005)
    assert _numbers(r'^level_2 set-point 0.08 m cannot be held, because pump_2 would have to be '
                    r'(\S+) V, but its range is 0 V to 12 V', tanks.names['rejection']) == [
        pytest.approx(u2, rel=0.2)]


def test_leak_leaves_an_offset_that_the_observer_removes_and_measures(tanks: Run) -> None:
    offsets = tanks.names['offsets']
    for before, _ in offsets.values():
        assert np.all(np.abs(before) < 1e-3)
    assert offsets['without observer'][1][1] < -0.01
    assert np.all(np.abs(offsets['with observer'][1]) < 1e-3)
    # derived by hand: a fifth of the outflow a sqrt(2 g h2) at 0.15 m, in V of the pump
    lost = -0.2 * 0.1781e-4 * np.sqrt(2.0 * 9.81 * 0.15) / 3.3e-6
    told, estimated = _numbers(r'the leak is worth (\S+) V of pump_2, estimated (\S+) V',
                               tanks.text)
    assert told == pytest.approx(lost, abs=0.005)
    assert estimated == pytest.approx(lost, abs=0.15)
    for run in tanks.names['runs'].values():
        assert np.all((run.commands >= 0.0) & (run.commands <= 12.0))


def test_controller_node_takes_the_file_of_the_tanks_by_the_command_shown(
        tanks: Run, ros: Harness) -> None:
    command, _ = (shlex.split(line) for line in re.findall('^ros2 run .*$', tanks.text, re.M))
    assert command[:5] == ['ros2', 'run', 'koopman_ros', 'controller', '--ros-args']
    heard = [ros.listen(JointState, f'{name}_setpoint') for name in PUMPS]
    ros.start('controller', {}, tuple(command[5:]))
    sensors = [ros.speak(JointState, name, to='controller') for name in LEVELS]
    stamps = iter(range(1, 10 ** 6))

    def answered() -> bool:
        stamp = stamp_message(next(stamps) * NANOSECONDS)
        for name, level, sensor in zip(LEVELS, TANKS.nominal_state, sensors, strict=True):
            message = JointState(name=[name], position=[float(level)])
            message.header.stamp = stamp
            sensor.publish(message)
        return all(len(messages) > 2 for messages in heard)

    ros.wait_until(answered)
    # what holds these levels in truth
    np.testing.assert_allclose([messages[2].position[0] for messages in heard],
                               TANKS.nominal_input, atol=0.3)


def test_equation_of_the_beam_is_read_off_its_polynomial(beam: Run) -> None:
    assert beam.names['found'].chosen.name == 'polynomial'
    assert beam.names['learned'] == {
        (1, 0): pytest.approx(400.0, rel=1e-9), (0, 1): pytest.approx(-8.0, rel=1e-9),
        (3, 0): pytest.approx(-4.0, rel=1e-9)}
    assert 'dv/dt has -4.000000000 x^3 v^0' in beam.text
    figures = {one.name: one.figures.fit for one in beam.names['found'].contenders}
    assert figures['polynomial'].rx < 1e-20 < figures['neural drift'].rx < 1e-4
    # nothing of this plant evolves linearly
    assert min(fit.rw for fit in figures.values()) > 0.05


def test_rubbing_beam_is_no_polynomial(beam: Run) -> None:
    rows = {one.name: one for one in beam.names['rough'].contenders}
    assert beam.names['rough'].chosen.name == 'neural drift'
    assert rows['neural drift'].rx < 0.1 * rows['polynomial'].rx
    assert 'neural drift  rx' in beam.text
    # the slope that is given for the friction is that of the friction
    system, x = beam.names['rubbing'], np.array([3.0, 20.0])
    steps = 1e-4 * np.eye(2)
    slope = (system.drift(x + steps) - system.drift(x - steps)).T / 2e-4
    np.testing.assert_allclose(system.drift_jacobian(x), slope, rtol=1e-5, atol=1e-6)


def test_weights_in_units_give_the_gain_of_the_textbook(beam: Run) -> None:
    A, B = np.array([[0.0, 1.0], [400.0, -8.0]]), np.array([[0.0], [1e4]])
    Q, R = np.diag([1.0, 1.0 / 2500.0]), np.array([[400.0]])
    K = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R))
    np.testing.assert_allclose(beam.names['gain'], K, rtol=1e-6)


def test_beam_is_held_on_the_slope(beam: Run) -> None:
    # derived by hand: 400 x - 4 x^3 is -1344 mm/s^2 at -4 mm, and 1 N is 10 000 mm/s^2
    assert beam.names['balance'] == pytest.approx([0.1344], abs=1e-9)
    linear, polynomial = beam.names['loops'].values()
    assert abs(polynomial.states[-1, 0] + 4.0) < 1e-3
    assert polynomial.inputs[-1, 0] == pytest.approx(0.1344, abs=1e-4)
    assert abs(linear.states[-1, 0] + 4.0) > 1.0
    assert polynomial.cost < 0.9 * linear.cost
    x = linear.states[-1, 0]
    assert linear.inputs[-1, 0] == pytest.approx(-1e-4 * (400.0 * x - 4.0 * x ** 3), abs=1e-3)
    assert max(np.max(np.abs(loop.inputs)) for loop in (linear, polynomial)) < 1.0


def _launched(given: dict[str, str]) -> list[SimpleNamespace]:
    """Return the nodes of the launch file, with arguments in place of substitutions."""
    default: dict[str, Any] = {}

    def value(name: str) -> str:
        parts = given.get(name, default[name])
        return parts if isinstance(parts, str) else ''.join(
            part() if callable(part) else part for part in parts)

    def declare(name: str, default_value: object, description: str) -> None:
        assert description
        default[name] = default_value

    modules = {
        'launch': {'LaunchDescription': lambda entities: [one for one in entities if one]},
        'launch.actions': {'DeclareLaunchArgument': declare},
        'launch.substitutions': {'LaunchConfiguration': lambda name: lambda: value(name)},
        'launch_ros': {},
        'launch_ros.actions': {'Node': SimpleNamespace},
        'launch_ros.parameter_descriptions': {
            'ParameterValue': lambda text, value_type: lambda: value_type(text() == 'true')},
        'launch_ros.substitutions': {'FindPackageShare': lambda name: str(ROOT)}}
    with pytest.MonkeyPatch.context() as patch:
        for name, content in modules.items():
            module = ModuleType(name)
            vars(module).update(content)
            patch.setitem(sys.modules, name, module)
        nodes = runpy.run_path(str(ROOT / 'examples' / 'loop.launch.py'))[
            'generate_launch_description']()
        for node in nodes:
            node.ros_arguments = [part() if callable(part) else part
                                  for part in node.ros_arguments]
            (node.parameters,) = node.parameters
            node.parameters = {name: one() for name, one in node.parameters.items()}
    return nodes


def test_launch_file_gives_its_parameter_file_to_all_nodes() -> None:
    nodes = _launched({'autostart': 'false', 'system': 'two_tanks'})
    assert [node.executable for node in nodes] == ['plant', 'controller', 'trainer']
    for node in nodes:
        assert node.package == 'koopman_ros'
        assert node.ros_arguments == [
            '--params-file', f'{ROOT}/config/plants/two_tanks.yaml', '--log-level', 'info']
        assert Path(node.ros_arguments[1]).is_file()
        assert node.parameters == {'autostart': False, **(
            {} if node.executable == 'plant' else {'use_sim_time': False})}
        assert (node.namespace(), node.respawn()) == ('', 'false')
    given = _launched({'parameters': 'loop.yaml', 'namespace': 'line_1', 'use_sim_time': 'true',
                       'log_level': 'debug', 'respawn': 'true'})
    for node in given:
        assert node.ros_arguments == ['--params-file', 'loop.yaml', '--log-level', 'debug']
        assert (node.namespace(), node.respawn()) == ('line_1', 'true')
    assert [node.parameters.get('use_sim_time') for node in given] == [None, True, True]


def test_no_node_starts_without_the_parameter_file_of_the_launch(ros: Harness) -> None:
    plant, *_ = _launched({'system': 'two_tansk'})
    process = ros.start(plant.executable, {}, tuple(plant.ros_arguments))
    assert ros.wait_for_end(process) == 1
    assert 'two_tansk.yaml' in process.output()


@pytest.mark.parametrize('path', sorted(TUTORIALS.glob('*.py')), ids=lambda path: path.stem)
def test_tutorials_are_cells_that_notebooks_open(path: Path) -> None:
    """As jupytext reads them: text in comments, code that Python compiles by itself."""
    head, *cells = re.split(r'^# %%', path.read_text(), flags=re.MULTILINE)
    assert all(line.startswith('# SPDX') for line in head.strip().splitlines())
    assert cells[0].startswith(' [markdown]\n# # ')
    for cell in cells:
        first, _, rest = cell.partition('\n')
        if first == ' [markdown]':
            assert all(line.startswith('#') for line in rest.strip().splitlines())
        else:
            assert first == ''
            compile(rest, path.name, 'exec')


def test_page_quotes_the_tutorials() -> None:
    _, _, page = (ROOT / 'docs' / 'how-to' / 'python.md').read_text().partition('# Use')
    sources = [path.read_text() for path in TUTORIALS.glob('*.py')]
    blocks = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    assert len(blocks) > 2
    for block in blocks:
        assert any(block in source for source in sources), block
    listed = re.findall(r'\(\.\./\.\./examples/tutorials/(\w+)\.py\)',
                        (ROOT / 'docs' / 'tutorials' / 'python_scripts.md').read_text())
    assert sorted(listed) == sorted(path.stem for path in TUTORIALS.glob('*.py'))


def test_the_page_without_ros_shows_the_real_output(
        tanks: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (ROOT / 'docs' / 'tutorials' / 'without_ros.md').read_text()
    block, printed = (''.join(re.findall(rf'```{kind}\n(.*?)```', page, re.DOTALL))
                      for kind in ('python', 'text'))
    folder = tmp_path / 'out' / 'tutorials'
    folder.mkdir(parents=True)
    shutil.copy(tanks.folder / 'results' / 'two_tanks.csv', folder)
    monkeypatch.chdir(tmp_path)
    said = io.StringIO()
    with redirect_stdout(said):
        exec(block, {})
    assert ': accepted\n' in said.getvalue()
    numbers = [re.findall(r'\d\.\d+ m|\d+\.\d %', text) for text in (said.getvalue(), printed)]
    values = [[float(one.split()[0]) for one in some] for some in numbers]
    np.testing.assert_allclose(values[0][:4], values[1], rtol=0.2)
    assert (tmp_path / 'two_tanks.safetensors').is_file()
    assert (tmp_path / 'loop.png').read_bytes().startswith(PNG)
    # the README has the same lines
    readme = (ROOT / 'README.md').read_text()
    for line in ('result = learn(record, unmeasured_states=0)', "run.draw('loop.png')"):
        assert f'{line}\n' in page
        assert f'{line}\n' in readme
