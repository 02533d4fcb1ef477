# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameter tables: words for ranges and rejections, and the shipped files that they write."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
import math
from pathlib import Path
import re
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.node import Node

from koopman_ros.core.paths import config_directory, model_path
from koopman_ros.demo import reactor
from koopman_ros.model import load
from koopman_ros.parameters.controller import table_of
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.parameters.signal_topics import plant_defaults, SignalTopics
from koopman_ros.parameters.table import (
    ConfigurationError,
    group,
    parameter,
    ParameterTable,
    per_signal,
    Specification,
)
from koopman_ros.parameters.trainer_table import trainer_signals, trainer_table
from koopman_ros.ros.node import LoopNode, range_of
from koopman_ros.ros.node_descriptions import main, POLICY_FILE, tables
from koopman_ros.ros.training import task_fields
from koopman_ros.testing import Harness

TABLES = tables()
PLANTS = sorted(path.stem for path in config_directory().glob('plants/*.yaml'))


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
def test_range_and_rejections_in_words(
        specification: Specification, words: str, good: list[Any], bad: dict[Any, str]) -> None:
    assert specification.range_text == words
    for given in good:
        assert specification.check(given) == ''
    for given, rejection in bad.items():
        assert specification.check(given) == f'level = {rejection}'


@pytest.mark.parametrize(('default', 'given', 'words'), [
    (1.0, 1, 'level = 1 must be a double, e.g. 1.0'),
    (True, 'yes', "level = 'yes' must be a boolean, e.g. true"),
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


def rejection(table: ParameterTable[Any], given: Mapping[str, Any]) -> str:
    """Return why a node would not start with the values, or an empty string."""
    try:
        return table.check(table.snapshot(given))
    except ConfigurationError as error:
        return str(error)


ODD = ParameterTable(Odd, lambda odd: 'count must be odd' if odd.count % 2 == 0 else '')


def test_ranges_are_checked_before_combinations() -> None:
    assert ODD.check(Odd()) == ''
    assert ODD.check(Odd(count=2)) == 'count must be odd'
    assert rejection(ODD, {'count': 2, 'tiny': 2.0}) == 'tiny = 2.0 m must be in [0, 1] m'


def _reciprocal(odd: Odd) -> float:
    if odd.whole == -1.0:
        raise ValueError('whole and count\nare no pair')
    return 1.0 / (odd.whole + odd.count)


BUILT = ParameterTable(Odd, build=_reciprocal)


@pytest.mark.parametrize(('before', 'now', 'reason'), [
    (Odd(), Odd(), ''),
    (Odd(), Odd(count=3), 'count = 3 is not usable: float division by zero'),
    (Odd(), Odd(count=4, whole=-4.0, tiny=0.5),
     'whole = -4.0 and count = 4 is not usable: float division by zero'),
    (Odd(count=4), Odd(count=4, whole=-4.0),
     'whole = -4.0 is not usable: float division by zero'),
    (Odd(), Odd(whole=-1.0), 'whole = -1.0 is not usable: whole and count are no pair'),
])
def test_a_value_that_fails_to_build_is_rejected_with_error_and_parameter(
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


def declared(ros: Harness, *arguments: str, name: str = 'odd',
             table: ParameterTable[Any] = ODD) -> Any:
    """Return the snapshot of a node started with arguments, and if it has what is not its own."""
    node = LoopNode(name, context=ros.node.context, cli_args=['--ros-args', *arguments])
    try:
        return node.declare_table(table), node.has_parameter('foreign')
    finally:
        node.destroy_node()


@pytest.mark.parametrize(('node', 'given', 'words'), [
    ('trainer', ('topics:=[]',), 'topics = [] must be a list of at least one string'),
    ('plant', ('speed:=[]',), 'speed = [] must be a double, e.g. 1.0'),
    ('controller', ('coolant_temperature.min:=20.0',
                    'coolant_temperature.max:=20.00000000000001'),
     'coolant_temperature.min = 20.0 degC must be below coolant_temperature.max'),
    ('trainer', ('max_bag_size:=1.0e+308',),
     'max_bag_size = 1e+308 MB must be 0, or in [1e-06, 1000000000] MB'),
])
def test_a_start_with_unusable_parameters_is_rejected(
        ros: Harness, node: str, given: tuple[str, ...], words: str) -> None:
    arguments = [part for argument in given for part in ('-p', argument)]
    with pytest.raises(ConfigurationError) as rejection:
        declared(ros, *arguments, table=TABLES[node])
    assert str(rejection.value).startswith(words)
    assert '\n' not in str(rejection.value)


# Signals.


@dataclass(frozen=True)
class Tuned:
    """What is tuned for one signal."""

    low: float = parameter(0.0, 'lowest value', '{shown}', -500.0, 500.0)
    high: float = parameter(1.0, 'highest value', '{shown}', -500.0, 500.0)
    rate: float = parameter(0.0, 'fastest change', '{unit}/s', 0.0, 10.0)
    weight: float = parameter(1.0, 'cost', '1/({unit})^2', 0.0, 10.0)


@dataclass(frozen=True)
class Several:
    """Parameters of a node, of its signals, and of a group."""

    period: float = parameter(1.0, 'time between samples', 's', 0.0, 10.0)
    signals: Mapping[str, Tuned] = per_signal(Tuned)
    constants: Mapping[str, float] = group()


SEVERAL = ParameterTable(
    Several, ordered=(('low', 'high'),), signals={'signals': {'heat': 'K', 'flow': 'm^3/s'}},
    groups={'constants': [Specification('gravity', 9.81, 'm/s^2', 'of the earth', 0.0, 20.0)]},
    defaults={'flow.high': 2, 'heat.nothing': 3.0, 'foreign': 1.0})


def test_each_signal_has_rows_of_its_own_in_its_units() -> None:
    assert {name: row.unit for name, row in SEVERAL.rows.items()} == {
        'period': 's',
        'heat.low': 'degC', 'heat.high': 'degC', 'heat.rate': 'K/s', 'heat.weight': '1/K^2',
        'flow.low': 'm^3/s', 'flow.high': 'm^3/s', 'flow.rate': 'm^3/s/s',
        'flow.weight': '1/(m^3/s)^2', 'constants.gravity': 'm/s^2'}
    given = SEVERAL.snapshot({'heat.low': -5.0, 'constants.gravity': 1.6, 'foreign': 4.0})
    assert (given.period, given.signals['heat'], dict(given.constants)) == (
        1.0, Tuned(low=-5.0), {'gravity': 1.6})
    # of the defaults, and a double though it was given as 2
    assert repr(given.signals['flow'].high) == '2.0'
    values = SEVERAL.values(given)
    assert list(values) == list(SEVERAL.rows)
    assert SEVERAL.snapshot(values) == given
    assert SEVERAL.amended(given, **{'flow.rate': 3.0}).signals['flow'].rate == 3.0


@pytest.mark.parametrize(('given', 'words'), [
    ({'heat.rate': 11.0}, 'heat.rate = 11.0 K/s must be in [0, 10] K/s'),
    ({'flow.low': 2.0}, 'flow.low = 2.0 m^3/s must be below flow.high = 2.0 m^3/s: change the '
     'other one first'),
    ({'heat.low': 3.0}, 'heat.low = 3.0 degC must be below heat.high = 1.0 degC: change the other '
     'one first'),
    ({'constants.gravity': -1.0}, 'constants.gravity = -1.0 m/s^2 must be in [0, 20] m/s^2'),
    ({}, ''),
])
def test_values_of_a_signal_are_rejected_by_its_name(given: dict[str, float], words: str) -> None:
    assert rejection(SEVERAL, given) == words


def read(ros: Harness, file: Path, names: Collection[str]) -> dict[str, Any]:
    """Return parameters as rcl reads them from a file."""
    node = Node('odd', context=ros.node.context,
                cli_args=['--ros-args', '--params-file', str(file)],
                automatically_declare_parameters_from_overrides=True)
    found = {name: node.get_parameter(name).value for name in names}
    node.destroy_node()
    return found


@pytest.mark.parametrize('name', ['odd', 'several', *TABLES])
def test_rcl_reads_the_parameter_file_of_a_table(ros: Harness, tmp_path: Path, name: str) -> None:
    table = {**TABLES, 'odd': ODD, 'several': SEVERAL}[name]
    file = tmp_path / 'written.yaml'
    file.write_text(table.yaml())
    default = {name: list(item.default) if isinstance(item.default, tuple) else item.default
               for name, item in table.rows.items()}
    found = read(ros, file, table.rows)
    assert found == default
    assert [type(value) for value in found.values()] == [type(value) for value in default.values()]


# Plants that are shipped, and former names.


@pytest.mark.parametrize('system', PLANTS)
def test_file_of_a_plant_fits_the_tables_of_its_nodes(system: str) -> None:
    of_plant = tables(system)
    everywhere = plant_defaults(system, '')
    assert everywhere['system'] == system
    assert set(everywhere) <= {name for table in of_plant.values() for name in table.rows}
    for node, table in of_plant.items():
        given = plant_defaults(system, node)
        assert set(given) <= {*table.rows, *everywhere}, node
        for name in set(given) & set(table.rows):
            # a replay has one table for all plants
            if node != 'replay':
                # what a node starts with is what is written, and of its type
                default = table.rows[name].default
                assert default == given[name], name
                assert isinstance(given[name], (int, float) if isinstance(default, float)
                                  else type(default)), name
        assert table.check(table.snapshot({})) == '', node


@pytest.mark.parametrize(('node', 'given', 'words'), [
    ('controller', {'coolant_temperature.command_topic': 'temperature'},
     "coolant_temperature is commanded on 'temperature', the topic on which temperature is"),
    ('controller', {'temperature.sensor_min': -300.0},
     r'temperature.sensor_min = -300.0 degC must be in \[-273.15, '),
    *(('trainer', given, words) for given, words in (
        ({'coolant_temperature.experiment_min': 30.0},
         'is not usable: coolant_temperature: lower = 303.15 must be below upper = 300.65'),
        ({'experiment_max_hold_time': 10.0}, 'hold_shortest = 30.0 s must be above 0 and at most'),
        ({'experiment_signal': 'setpoints'}, 'must be one of command, manual, setpoint'),
        *(({'output': 'run.mcap', **limit}, 'which max_bag_size and max_bag_duration cannot split')
          for limit in ({'max_bag_size': 1.0}, {'max_bag_duration': 60.0})),
        ({'physical_model': 'two_thanks'}, "unknown plant 'two_thanks'"),
        ({'physical_model': 'two_state', 'estimated_constants': ['volumes']},
         'volumes is not a constant of TwoStateReactor: choose from flow_rate, volume'),
        ({'physical_model': 'two_state', 'estimated_constants': ['volume [2, 1]']},
         r'the range of volume is \[2, 1\] m\^3, must increase and lie in \[0.001, 100\] m\^3'),
        ({'physical_model': 'two_state', 'estimated_constants': ['volume 2 1']},
         'must be a name, optionally'),
        ({'physical_model': 'two_state', 'estimated_constants': ['volume', 'volume']},
         'each name once'),
        ({'physical_model': 'quadruple_tank'},
         'marks no constants as estimated'),
        ({'estimated_constants': ['volume']}, 'estimated_constants names volume, but there'),
        ({'coolant_temperature.characteristic': [10.0, 1.0, 20.0, 0.0]}, 'do not fall'),
        ({'physical_model': 'two_state', 'unmeasured_states': 1},
         'unmeasured_states is 1, must be 0'),
        ({'physical_model': 'two_state', 'input_matrix': [2.0]},
         'input_matrix must be a single 0')))])
def test_values_that_do_not_fit_together_are_rejected(
        node: str, given: dict[str, Any], words: str) -> None:
    table = TABLES[node]
    assert re.search(words, rejection(table, given))


@pytest.mark.parametrize(('given', 'words'), [
    # of jacket_temperature [K], too, the command is that of the jacket
    ({'states_measured': ('T [K]',), 'inputs_commanded': ('jacket [K]', 'jacket_temperature [K]')},
     "jacket and jacket_temperature are both in the field temperature of 'jacket_setpoint'"),
    ({'states_measured': ('a [m]', 'b [m]'), 'inputs_commanded': ('u [V]',), 'a.topic': 'levels',
      'b.topic': 'levels', 'b.field': 'position[a]'},
     "a and b are both in the field position[a] of 'levels'")])
def test_two_signals_in_one_place_are_rejected(given: dict[str, Any], words: str) -> None:
    table = trainer_table(None, {'system': '', **given})
    assert words in table.check(table.snapshot(given))


def test_measured_disturbances_have_rows_topics_and_a_place_in_the_task() -> None:
    named = {'system': 'reactor', 'disturbances_measured': ('feed_temperature [K]',)}
    trainer = trainer_table(load(model_path(reactor.MODEL)), named)
    settings = trainer.snapshot({'input_matrix': (0.1, 0.2)})
    assert not trainer.check(settings)
    assert settings.topics[-1] == 'feed_temperature'
    signals = trainer_signals(None, {**plant_defaults('reactor', 'trainer'), **named})
    task = settings.training(signals)
    assert task['disturbances'] == ('feed_temperature',)
    assert task['input_gain'] == {'temperature': {
        'coolant_temperature': 0.1, 'feed_temperature': 0.2}}
    wiring = SignalTopics.of(signals, settings)
    *_, feed = task_fields(SimpleNamespace(resolve_topic_name='/{}'.format), settings, wiring, ()
                           )['inputs']
    assert (feed['name'], feed['command']) == ('feed_temperature', None)
    assert (feed['measured']['topic'], feed['measured']['unit']) == ('/feed_temperature', 'degC')
    assert 'must have 1 rows of 2' in trainer.check(trainer.snapshot({'input_matrix': (0.1,) * 3}))
    assert 'with measured' in trainer.check(trainer.snapshot({'input_matrix_degree': 1}))
    # those of the model where none are named
    assert trainer_signals(load(model_path('reactor_feed')), plant_defaults(
        'reactor', 'trainer')).disturbances == {'feed_temperature': 'K'}
    rows = table_of(load(model_path('reactor_feed')), {'system': 'reactor'}).rows
    assert rows['feed_temperature.topic'].default == 'feed_temperature'
    assert rows['feed_temperature.sensor_max'].unit == 'degC'
    assert rows['feed_temperature.timeout'].default == 60.0
    plant = PlantTable(named)
    values = plant.snapshot({'constants.feed_temperature': 80.0})
    assert plant.measured_disturbances(values) == pytest.approx([353.15])
    for given, words in (('spin [1]', 'not a constant of reactor'), ('volume [K]', 'volume: ')):
        with pytest.raises(ConfigurationError, match=words):
            PlantTable({**named, 'disturbances_measured': (given,)})


@pytest.mark.parametrize(('name', 'levels'), [
    ('reactor_nz4', ('sdre', 'linear')), ('two_state', ('sdre', 'linear')),
    ('pendulum', ('mpc', 'sdre', 'linear')), ('two_state_example', ('mpc', 'sdre', 'linear'))])
def test_an_unstable_plant_is_planned_for(name: str, levels: tuple[str, ...]) -> None:
    tuning = table_of(load(model_path(name)), {'system': ''}).snapshot({}).tuning
    assert tuning.fallback_order == levels


# The shipped files.


def test_shipped_parameter_files_are_up_to_date(tmp_path: Path) -> None:
    assert main(['--output', str(tmp_path)]) == 0
    written = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert set(written) == {*(f'{node}.yaml' for node in TABLES), POLICY_FILE}
    for name, text in written.items():
        assert (config_directory() / name).read_text() == text, name
