# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameter tables: words for ranges and refusals, and the shipped files that they write."""

from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.parameter import parameter_dict_from_yaml_file, parameter_value_to_python
import yaml

from koopman_ros.parameters.plant import PlantParameters
from koopman_ros.parameters.table import (
    ConfigurationError,
    parameter,
    ParameterTable,
    Specification,
)
from koopman_ros.resources import config_directory
from koopman_ros.ros.node import LoopNode, range_of
from koopman_ros.ros.programs import main, POLICY_FILE, TABLES
from koopman_ros.testing import Harness


def row(default: Any, **details: Any) -> Specification:
    return Specification('level', default, **{'unit': 'm', 'description': 'fill', **details})


# Words.


@pytest.mark.parametrize(('specification', 'words', 'good', 'bad'), [
    (row(1.0), '', [1e300],
     {math.nan: 'nan m must be finite', -math.inf: '-inf m must be finite'}),
    (row(1.0, minimum=0.0), 'at least 0 m', [0.0, 1e300],
     {-1.0: '-1.0 m must be at least 0 m', math.inf: 'inf m must be at least 0 m'}),
    (row(1.0, minimum=0.0, open_minimum=True), 'above 0 m', [1e-300],
     {0.0: '0.0 m must be above 0 m'}),
    (row(1.0, minimum=0.0, maximum=5.0), '[0, 5] m', [0.0, 5.0],
     {5.5: '5.5 m must be in [0, 5] m', math.nan: 'nan m must be in [0, 5] m'}),
    (row(1.0, minimum=0.0, maximum=5.0, open_minimum=True), '(0, 5] m', [5.0],
     {0.0: '0.0 m must be in (0, 5] m'}),
    (row(1, minimum=1, maximum=1000, unit=''), '[1, 1000]', [1], {0: '0 must be in [1, 1000]'}),
    (row(1.0, minimum=0.0, smallest=0.01, maximum=5.0), '0, or in [0.01, 5] m', [0.0, 0.01],
     {0.001: '0.001 m must be 0, or in [0.01, 5] m', math.nan: 'nan m must be 0, or in [0.01, 5] '
      'm'}),
    (row('low', choices=('low', 'high'), unit=''), 'one of low, high', ['high'],
     {'up': "'up' must be one of low, high"}),
    (row(True), '', [False], {}),
    (row('anything'), '', [''], {}),
])
def test_range_and_refusals_in_words(
        specification: Specification, words: str, good: list[Any], bad: dict[Any, str]) -> None:
    assert specification.range_text == words
    for given in good:
        assert specification.check(given) == ''
    for given, refusal in bad.items():
        assert specification.check(given) == f'level = {refusal}'


@pytest.mark.parametrize(('default', 'given', 'words'), [
    (1.0, 1, 'level = 1 must be a double, e.g. 1.0'),
    (1, 1.5, 'level = 1.5 must be an integer, e.g. 1'),
    (True, 'yes', "level = 'yes' must be a boolean, e.g. true"),
    ('low', 3, 'level = 3 must be a string, e.g. text'),
    (('a',), 'a', "level = 'a' must be a list of strings, e.g. [a, b]"),
    (('a',), [], 'level = [] must be a list of at least one string, e.g. [a, b]'),
])
def test_other_type_is_named_with_an_example(default: Any, given: Any, words: str) -> None:
    assert row(default).type_error(given) == words


@dataclass(frozen=True)
class Odd:
    """A parameter of every type, with values that are hard to write."""

    tiny: float = parameter(1e-6, 'a small number', unit='m', minimum=0.0, maximum=1.0)
    huge: float = parameter(7.2e30, 'a large number')
    whole: float = parameter(-3.0, 'a whole number that is a double')
    exact: float = parameter(0.87725294608097, 'all digits')
    count: int = parameter(-7, 'an integer')
    switch: bool = parameter(True, 'a switch', read_only=True)
    word: str = parameter('on', 'a string that YAML could take for a switch')
    empty: str = parameter('', 'nothing')
    names: tuple[str, ...] = parameter(('temperature', '/diagnostics'), 'a list')


ODD = ParameterTable(Odd, lambda odd: 'count must be odd' if odd.count % 2 == 0 else '')


def test_cross_check_comes_after_the_ranges() -> None:
    assert ODD.check(Odd()) == ''
    assert ODD.check(Odd(count=2)) == 'count must be odd'
    assert ODD.check(Odd(count=2, tiny=2.0)) == 'tiny = 2.0 m must be in [0, 1] m'


def _reciprocal(odd: Odd) -> float:
    if odd.whole == -1.0:
        raise ValueError('whole and count\nare no pair')
    return 1.0 / (odd.whole + odd.count)


BUILT = ParameterTable(Odd, build=_reciprocal)


@pytest.mark.parametrize(('before', 'now', 'reason'), [
    (Odd(), Odd(), ''),
    (Odd(), Odd(count=3), 'count = 3 cannot be used: float division by zero'),
    (Odd(), Odd(count=4, whole=-4.0, tiny=0.5),
     'whole = -4.0 and count = 4 cannot be used: float division by zero'),
    (Odd(count=4), Odd(count=4, whole=-4.0),
     'whole = -4.0 cannot be used: float division by zero'),
    (Odd(), Odd(whole=-1.0), 'whole = -1.0 cannot be used: whole and count are no pair'),
])
def test_what_cannot_be_built_is_refused_with_the_error_and_what_was_changed(
        before: Odd, now: Odd, reason: str) -> None:
    assert BUILT.check(now, before) == (reason and f'{reason}; choose another value')


@pytest.mark.parametrize('node', TABLES)
def test_every_number_has_a_range_that_a_slider_can_show(node: str) -> None:
    for item in TABLES[node].rows.values():
        if isinstance(item.default, bool) or not isinstance(item.default, (int, float)):
            assert range_of(item) is None
            continue
        limits = range_of(item)
        assert limits is not None
        assert (limits.from_value, limits.to_value) == (item.minimum, item.maximum)
        assert limits.step == 0


@pytest.mark.parametrize('node', TABLES)
def test_what_is_dumped_can_be_loaded_again(ros: Harness, tmp_path: Path, node: str) -> None:
    """As `ros2 param dump` writes it, and as `ros2 param load` and a node at its start read."""
    defaults = {name: list(item.default) if isinstance(item.default, tuple) else item.default
                for name, item in TABLES[node].rows.items()}
    file = tmp_path / 'dumped.yaml'
    file.write_text(yaml.dump({f'/{node}': {'ros__parameters': defaults}},
                              default_flow_style=False))
    loaded = {name: parameter_value_to_python(message.value)
              for name, message in parameter_dict_from_yaml_file(str(file)).items()}
    reader = LoopNode(node, context=ros.node.context,
                           cli_args=['--ros-args', '--params-file', str(file)])
    started = {name: reader.get_parameter(name).value for name in defaults}
    reader.destroy_node()
    for read in (loaded, started):
        assert read == defaults
        assert {name: type(value) for name, value in read.items()} == {
            name: type(value) for name, value in defaults.items()}


def declared(ros: Harness, *arguments: str, name: str = 'odd',
             table: ParameterTable[Any] = ODD) -> Any:
    """Return the snapshot of a node started with arguments, and if it has what is not its own."""
    node = LoopNode(name, context=ros.node.context, cli_args=['--ros-args', *arguments])
    try:
        return node.declare_table(table), node.has_parameter('foreign')
    finally:
        node.destroy_node()


def test_names_of_other_nodes_are_ignored_with_one_warning(
        ros: Harness, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / 'shared.yaml'
    file.write_text('/**:\n  ros__parameters:\n    count: 5\n    foreign: 1.0\n    cuont: 7\n'
                    '    nothing: []\n    more:\n      than: one\n')
    assert declared(ros, '--params-file', str(file)) == (Odd(count=5), False)
    (line,) = capfd.readouterr().err.splitlines()
    assert '[WARN]' in line
    assert line.endswith("[odd]: parameters that this node does not have are ignored: 'foreign', "
                         "'cuont' (did you mean count?), 'more.than'")


@pytest.mark.parametrize(('node', 'given', 'words'), [
    *((node, (f'{name}:=[]',), f'{name} = [] must be a list of at least one string, e.g. [a, b]')
      for node, name in (('trainer', 'topics'), ('trainer', 'bags'), ('player', 'topics'),
                         ('replay', 'bags'))),
    ('plant', ('speed:=[]',), 'speed = [] must be a double, e.g. 1.0'),
    ('controller', ('coolant_min:=20.0', 'coolant_max:=20.00000000000001'),
     'coolant_min = 20.0 degC and coolant_max = 20.00000000000001 degC cannot be used: '),
    ('replay', ('sensor_min:=20.0', 'sensor_max:=20.00000000000001'),
     'sensor_min = 20.0 degC and sensor_max = 20.00000000000001 degC cannot be used: '),
    ('trainer', ('experiment_coolant_max:=8.500000000000002',),
     'experiment_coolant_max = 8.500000000000002 degC cannot be used: '),
    ('trainer', ('max_bag_size:=1.0e+308',),
     'max_bag_size = 1e+308 MB must be 0, or in [1e-06, 1000000000] MB'),
])
def test_start_with_what_cannot_be_used_is_refused(
        ros: Harness, node: str, given: tuple[str, ...], words: str) -> None:
    arguments = [part for argument in given for part in ('-p', argument)]
    with pytest.raises(ConfigurationError) as refusal:
        declared(ros, *arguments, table=TABLES[node])
    assert str(refusal.value).startswith(words)
    assert '\n' not in str(refusal.value)


def test_concentration_too_small_to_integrate_is_refused() -> None:
    table = TABLES['plant']
    assert table.check(PlantParameters(feed_concentration=1e-315)) == ''
    assert table.check(PlantParameters(reactor='two_state', feed_concentration=1e-315)).startswith(
        'reactor = two_state and feed_concentration = 1e-315 mol/L cannot be used: atol is ')
    for harmless in (0.0, 1e-100):
        assert table.check(PlantParameters(
            reactor='two_state', feed_concentration=harmless)) == ''


@pytest.mark.parametrize(('given', 'residual'), [
    ({}, 1e-8), ({'min_riccati_digits': 6.0}, 1e-6), ({'max_riccati_residual': 1e-5}, 1e-5),
    ({'max_riccati_residual': 1e-9, 'min_riccati_digits': 3.0}, 1e-9),
])
def test_former_form_of_the_riccati_bound_still_counts(
        given: dict[str, float], residual: float) -> None:
    for node in ('controller', 'replay'):
        settings = TABLES[node].kind(**given).settings()
        assert settings.max_residual == pytest.approx(residual, rel=1e-15)


def test_rcl_reads_back_what_the_table_writes(ros: Harness, tmp_path: Path) -> None:
    file = tmp_path / 'odd.yaml'
    file.write_text(ODD.yaml())
    node = Node('odd', context=ros.node.context,
                cli_args=['--ros-args', '--params-file', str(file)],
                automatically_declare_parameters_from_overrides=True)
    read = {name: node.get_parameter(name).value for name in ODD.rows}
    node.destroy_node()
    default = {name: item.default for name, item in ODD.rows.items()}
    assert read == {**default, 'names': list(default['names'])}
    assert [type(found) for found in read.values()] == [
        float, float, float, float, int, bool, str, str, list]


# The shipped files.


def test_shipped_files_are_what_one_command_writes(tmp_path: Path) -> None:
    assert main(['--output', str(tmp_path)]) == 0
    written = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert set(written) == {*(f'{node}.yaml' for node in TABLES), POLICY_FILE}
    for name, text in written.items():
        assert (config_directory() / name).read_text() == text, name
