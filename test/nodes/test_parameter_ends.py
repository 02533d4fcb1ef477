# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Every parameter of every table at both ends of its range: what is accepted can be used."""

from collections.abc import Callable, Mapping
import itertools
import math
import random
from typing import Any

import pytest
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool

from koopman_ros.demo import reactor
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.nodes.plant import PlantNode
from koopman_ros.nodes.trainer import TrainerNode
from koopman_ros.parameters.table import ConfigurationError, Specification
from koopman_ros.plants import simulation
from koopman_ros.ros import topics
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.node_descriptions import tables
from koopman_ros.testing import Harness
from support.nodes import running, seconds, temperature

TABLES = tables()
STEADY = 51.8  # degC, near the plant's steady state
DENORMAL = 5e-324
# What the names of the trainer's parameters for experiments begin with.
EXPERIMENT = ('experiment', 'coolant_temperature.experiment', 'coolant_temperature.safe_value',
              'temperature.experiment', 'temperature.setpoint')
# A lower limit and its upper one, which must change together to reach the ends.
PAIRS = (('learned_model_margin', 'linear_model_margin'),
         ('experiment_min_hold_time', 'experiment_max_hold_time'),
         *((f'{name}min', f'{name}max') for name in (
             'coolant_temperature.', 'mpc.temperature.', 'temperature.sensor_',
             'coolant_temperature.experiment_', 'temperature.experiment_',
             'temperature.setpoint_')))


def ends(row: Specification) -> list[Any]:
    """Return the values at the ends of a range, and what lies nearest to an end at 0."""
    if row.choices or isinstance(row.default, bool):
        return list(row.choices) or [False, True]
    if not isinstance(row.default, (int, float)):
        return []
    assert math.isfinite(row.minimum)
    assert math.isfinite(row.maximum)
    kind = type(row.default)
    low = [] if row.open_minimum else [kind(row.minimum)]
    if kind is float and row.minimum == 0.0:
        low.append(row.smallest or DENORMAL)
    return [*low, kind(row.maximum)]


def with_partner(rows: Mapping[str, Specification], name: str, value: Any) -> dict[str, Any]:
    """Return the change with the other limit of the pair, where that has to give way."""
    for low, high in PAIRS:
        if low not in rows:
            continue
        if name == low and value == rows[low].maximum:
            # just below the top, which the other one has
            return {low: value - 1.0, high: rows[high].maximum}
        if name == high and value == rows[high].minimum:
            return {low: rows[low].minimum, high: value + 1.0}
        if name == high:
            return {low: min(rows[low].default, value), high: value}
    return {name: value}


def cases(table: str) -> list[dict[str, Any]]:
    """Return the changes that bring each parameter of a table to its ends, while a node runs."""
    rows = TABLES[table].rows
    return [with_partner(rows, name, value) for name, row in rows.items()
            if not row.read_only for value in ends(row)]


def usable_for_itself(reason: str) -> bool:
    """Tell whether a value is rejected that its range has: next to nothing, or the only weight."""
    return ' = 5e-324' in reason or (
        'temperature.weight = 0.0 1/K^2' in reason and ' is not usable: ' in reason)


def try_each(node: ManagedNode, changes: list[dict[str, Any]], use: Callable[[], object]) -> int:
    """Use a node after each change, which is then taken back; return how many were accepted."""
    def change(values: Mapping[str, Any]) -> SetParametersResult:
        return node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()])

    rows, accepted = TABLES[node.get_name()].rows, 0
    for values in changes:
        result = change(values)
        accepted += result.successful
        if result.successful:
            use()
        else:
            assert usable_for_itself(result.reason), result.reason
        result = change({name: rows[name].default for name in values})
        assert result.successful, result.reason
    return accepted


def fire_timers(node: ManagedNode) -> None:
    """Do the work of every timer now, whatever its period."""
    for timer in list(node.timers):
        timer.callback()


def finite(messages: list[Temperature]) -> bool:
    return all(math.isfinite(message.temperature) for message in messages)


def at_once(draw: random.Random) -> dict[str, Any]:
    """Draw an end or the default for all parameters of a controller."""
    rows = TABLES['controller'].rows
    change = {name: draw.choice([*ends(row), row.default])
              for name, row in rows.items() if ends(row) and not row.read_only}
    for low, high in PAIRS:
        # one pair in four would be drawn in order
        if low in rows and not change[low] < change[high]:
            change[low], change[high] = rows[low].minimum, rows[high].maximum
    return change


def test_controller_answers_with_each_parameter_and_with_all_at_their_ends(ros: Harness) -> None:
    with running(ros, ControllerNode, {}) as node:
        commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        sensor = ros.speak(Temperature, reactor.TEMPERATURE, to='controller')
        times = itertools.count(1)

        def answer() -> None:
            at = next(times)
            sensor.publish(temperature(STEADY + 0.01 * (at % 3), float(at)))
            # others may follow that answer silence
            ros.wait_until(lambda: at in map(seconds, commands))
            assert finite(commands)
            del commands[:]

        def work() -> None:
            answer()
            fire_timers(node)
            answer()

        try_each(node, cases('controller'), work)
        draw = random.Random(1)
        assert try_each(node, [at_once(draw) for _ in range(40)], work) >= 5


def test_plant_runs_with_every_changeable_parameter_at_its_ends(
        ros: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    # of a reactor that has become stiff the plant says so, sooner or later
    monkeypatch.setattr(simulation, '_MAX_STEPS_PER_HOLD', 500)
    with running(ros, PlantNode, {'speed': 0.0, 'sample_period': 0.1}) as node:
        heard = ros.listen(Temperature, reactor.TEMPERATURE)
        coolant = ros.speak(Temperature, reactor.COOLANT_SETPOINT, to='plant')

        def work() -> None:
            assert ros.trigger('plant/reset').success
            del heard[:], ros.statuses[:]
            coolant.publish(temperature(20.0))
            fire_timers(node)
            ros.wait_until(lambda: len(heard) > 2 or any(
                'stopped: ' in status.message for status in ros.statuses))
            assert finite(heard)

        try_each(node, cases('plant'), work)


def test_trainer_steps_with_every_parameter_of_the_experiment_at_its_ends(ros: Harness) -> None:
    with running(ros, TrainerNode, {'record_at_start': False}) as node:
        commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        sensor = ros.node.create_publisher(Temperature, reactor.TEMPERATURE, topics.LOOP_QOS)
        client = ros.node.create_client(SetBool, 'trainer/experiment')
        ros.wait_until(client.service_is_ready)
        times = itertools.count(1)

        def work() -> None:
            begun = client.call_async(SetBool.Request(data=True))
            while not begun.done():
                sensor.publish(temperature(40.0, float(next(times))))
                ros.spin_once()
                fire_timers(node)
            assert begun.result().success or begun.result().message.startswith('rejected: ')
            for _ in range(2):
                ros.set_bool('trainer/experiment', False)
            assert finite(commands)

        try_each(node, [change for change in cases('trainer')
                        if next(iter(change)).startswith(EXPERIMENT)], work)


def test_trainer_rejects_names_that_cannot_be_topics(ros: Harness) -> None:
    with running(ros, TrainerNode, {'record_at_start': False}) as node:
        for name, words in (('{pump}', 'unknown substitution'),
                            ('a//b', 'topic name must not contain'),
                            ('x' * 5000, 'topic length should not exceed')):
            result = node.set_parameters_atomically([Parameter('topics', value=[name])])
            assert not result.successful
            assert words in result.reason
            assert len(result.reason.splitlines()) == 1
            assert len(result.reason) < 250
    with (pytest.raises(ConfigurationError, match='unknown substitution'),
          running(ros, TrainerNode, {
              'record_at_start': False, 'topics': "['{pump}']"})):
        pass
