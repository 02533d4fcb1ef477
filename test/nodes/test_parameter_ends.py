# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Every parameter of every table at both ends of its range: what is accepted can be used."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
import math
import random
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import Temperature
from std_srvs.srv import SetBool, Trigger

from koopman_ros.demo import reactor
from koopman_ros.nodes.controller import ControllerNode
from koopman_ros.nodes.plant import PlantNode
from koopman_ros.nodes.trainer import TrainerNode
from koopman_ros.parameters.table import ConfigurationError, Specification
from koopman_ros.plants import simulation
from koopman_ros.ros import topics
from koopman_ros.ros.managed import ManagedNode
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.node_descriptions import tables
from koopman_ros.testing import isolated_domain
from support.nodes import seconds, temperature, TIMEOUT

TABLES = tables()
STEADY = 51.8  # degC, near the plant's steady state
DENORMAL = 5e-324
TINY = 1e-300
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
        # a file cannot hold a denormal number
        low.append(row.smallest or (TINY if row.read_only else DENORMAL))
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


def cases(table: str, *, read_only: bool) -> list[dict[str, Any]]:
    """Return the changes that bring each parameter of a table to its ends."""
    rows = TABLES[table].rows
    return [with_partner(rows, name, value) for name, row in rows.items()
            if row.read_only is read_only for value in ends(row)]


def usable_for_itself(reason: str) -> bool:
    """Tell whether a value is refused that its range has: next to nothing, or the only weight."""
    return ' = 5e-324' in reason or (
        'temperature.weight = 0.0 1/K^2' in reason and ' cannot be used: ' in reason)


class Site:
    """A node with somebody who talks to it, all in this thread: what the node raises is raised."""

    def __init__(self, node: LoopNode) -> None:
        self.node = node
        self.bench = Node('bench', start_parameter_services=False, enable_rosout=False)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(node)
        self.executor.add_node(self.bench)
        self.statuses: list[str] = []
        self.bench.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, lambda message: self.statuses.extend(
                status.message for status in message.status), 100)

    def listen(self, topic: str) -> list[Temperature]:
        heard: list[Temperature] = []
        self.bench.create_subscription(Temperature, topic, heard.append, topics.LOOP_QOS)
        return heard

    def spin_until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.05)

    def ask(self, kind: Any, service: str, **request: Any) -> Future:
        client = self.bench.create_client(kind, f'{self.node.get_name()}/{service}')
        self.spin_until(client.service_is_ready)
        return client.call_async(kind.Request(**request))

    def call(self, kind: Any, service: str, **request: Any) -> Any:
        future = self.ask(kind, service, **request)
        self.spin_until(future.done)
        return future.result()

    def fire_timers(self) -> None:
        """Do the work of every timer now, whatever its period."""
        for timer in list(self.node.timers):
            timer.callback()

    def change(self, **values: Any) -> bool:
        """Change parameters as the services do; what is refused says which, and why."""
        result = self.node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()])
        assert result.successful or usable_for_itself(result.reason), result.reason
        return result.successful


@contextlib.contextmanager
def site(create: Callable[[], LoopNode], **parameters: Any) -> Iterator[Site]:
    """Run a node in a domain of its own, with parameters given at its start."""
    given = [part for name, value in parameters.items() for part in (
        '-p', f'{name}:={str(value).lower() if isinstance(value, bool) else value}')]
    with isolated_domain(), contextlib.ExitStack() as stack:
        rclpy.init(args=['--ros-args', *given] if given else [])
        stack.callback(rclpy.shutdown)
        found = Site(create())
        stack.callback(found.node.destroy_node)
        if isinstance(found.node, ManagedNode):
            found.node.start()
        stack.callback(found.bench.destroy_node)
        stack.callback(found.executor.shutdown)
        stack.callback(found.node.complete)
        yield found


def defaults(table: str, names: Mapping[str, Any]) -> dict[str, Any]:
    return {name: TABLES[table].rows[name].default for name in names}


class Loop:
    """A sensor at a controller."""

    def __init__(self, place: Site) -> None:
        self.place, self.sent = place, 0
        self.commands = place.listen(reactor.COOLANT_SETPOINT)
        self.sensor = place.bench.create_publisher(
            Temperature, reactor.TEMPERATURE, topics.LOOP_QOS)
        place.spin_until(lambda: self.sensor.get_subscription_count()
                         and place.node.count_subscribers(reactor.COOLANT_SETPOINT))

    def answer(self) -> None:
        self.sent += 1
        self.sensor.publish(temperature(STEADY + 0.01 * (self.sent % 3), float(self.sent)))
        # others may follow that answer silence
        self.place.spin_until(lambda: self.sent in map(seconds, self.commands))
        assert all(math.isfinite(command.temperature) for command in self.commands)
        del self.commands[:]

    def work(self) -> None:
        self.answer()
        self.place.fire_timers()
        self.answer()


def test_controller_answers_with_every_parameter_at_its_ends() -> None:
    with site(ControllerNode) as place:
        loop = Loop(place)
        for change in cases('controller', read_only=False):
            if place.change(**change):
                loop.work()
            assert place.change(**defaults('controller', change))


def test_controller_answers_with_all_parameters_at_ends_at_once() -> None:
    rows = TABLES['controller'].rows
    draw = random.Random(1)
    accepted = 0
    with site(ControllerNode) as place:
        loop = Loop(place)
        for _ in range(40):
            change = {name: draw.choice([*ends(row), row.default])
                      for name, row in rows.items() if ends(row) and not row.read_only}
            for low, high in PAIRS:
                # one pair in four would be drawn in order
                if low in rows and not change[low] < change[high]:
                    change[low], change[high] = rows[low].minimum, rows[high].maximum
            if place.change(**change):
                accepted += 1
                loop.work()
    assert accepted >= 5


def test_plant_runs_with_every_changeable_parameter_at_its_ends(
        monkeypatch: pytest.MonkeyPatch) -> None:
    # of a reactor that has become stiff the plant says so, sooner or later
    monkeypatch.setattr(simulation, '_MAX_STEPS_PER_HOLD', 500)
    with site(PlantNode, speed=0.0, sample_period=0.1) as place:
        heard = place.listen(reactor.TEMPERATURE)
        coolant = place.bench.create_publisher(
            Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)
        place.spin_until(lambda: heard and coolant.get_subscription_count())
        for change in cases('plant', read_only=False):
            if place.change(**change):
                del heard[:], place.statuses[:]
                coolant.publish(temperature(20.0))
                place.fire_timers()
                place.spin_until(lambda: len(heard) > 2 or any(
                    'stopped: ' in text for text in place.statuses))
                assert all(math.isfinite(message.temperature) for message in heard)
            assert place.change(**defaults('plant', change))
            assert place.call(Trigger, 'reset').success


def test_trainer_refuses_names_that_cannot_be_topics() -> None:
    refusal = ' cannot be used (failed to resolve name: '
    with site(TrainerNode, record_at_start=False) as place:
        for name, shown, words in (
                ('{nobody}', '{nobody}', 'unknown substitution'),
                ('a//b', 'a//b', 'topic name must not contain'),
                ('x' * 5000, f'{"x" * 12}...{"x" * 13}', 'topic length should not exceed')):
            result = place.node.set_parameters_atomically([Parameter('topics', value=[name])])
            assert not result.successful
            assert result.reason.startswith(f"topics: '{shown}'{refusal}{words}")
            assert '\n' not in result.reason
    with (pytest.raises(ConfigurationError, match='unknown substitution'),
          site(TrainerNode, record_at_start=False, topics="['{nobody}']")):
        pass


def test_trainer_steps_with_every_parameter_of_the_experiment_at_its_ends() -> None:
    with site(TrainerNode, record_at_start=False) as place:
        sensor = place.bench.create_publisher(Temperature, reactor.TEMPERATURE, topics.LOOP_QOS)
        commands, sent = place.listen(reactor.COOLANT_SETPOINT), 0
        for change in cases('trainer', read_only=False):
            if not next(iter(change)).startswith(EXPERIMENT):
                continue
            if place.change(**change):
                begun = place.ask(SetBool, 'experiment', data=True)
                while not begun.done():
                    sent += 1
                    sensor.publish(temperature(40.0, float(sent)))
                    place.executor.spin_once(timeout_sec=0.01)
                    place.fire_timers()
                assert begun.result().success or begun.result().message.startswith('refused: ')
                place.call(SetBool, 'experiment', data=False)
                place.call(SetBool, 'experiment', data=False)
                assert all(math.isfinite(message.temperature) for message in commands)
            assert place.change(**defaults('trainer', change))
