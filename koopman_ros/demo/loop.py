# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The closed loop of a demo: plant, controller and trainer in lock-step, and its operator."""

from collections.abc import Callable, Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
from functools import partial
import os
from pathlib import Path
import re
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool, Trigger

from koopman_ros.core.message_fields import MessageField
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.signal_topics import SignalTopics
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.ros import topics
from koopman_ros.ros.signals import SignalPublisher, SignalSample, SignalSubscriber
from koopman_ros.ros.time_conversion import stamp_message
from koopman_ros.testing import deferred_interrupt, Harness, HarnessError

_START_TIME = 1.0  # s of plant time at the first measurement
FIRST_STAMP_NS = round(_START_TIME * NANOSECONDS)
_DISCOVERY = 1.0  # s in which the nodes of a domain are found
_NODES = ('plant', 'controller', 'trainer', 'panel')
#: what to do if messages are missing in a recording
BUSY = 'the machine was too busy: end other programs, and run the demo again'
_TIMEOUT = 30.0  # s for the processes to find each other, and from one command to the next


@dataclass(frozen=True)
class Scenario:
    """The setup of a closed loop."""

    #: new set-points, by signal and in its unit; none if another node publishes them
    setpoints: Mapping[str, float]
    system: str = 'reactor'  #: plant that is shipped
    step_time: float = 60.0  #: when they take effect, in s after the first measurement
    duration: float = 600.0  #: length of the run in s of plant time, 0 for endless
    sample_period: float = 1.0  #: s between measurements
    speed: float = 0.0  #: simulated seconds per second, 0 for as fast as the machine can
    #: constants of the plant that are measured, with their units
    disturbances: tuple[str, ...] = ()
    #: further parameters of the nodes
    plant: Mapping[str, object] = field(default_factory=dict)
    controller: Mapping[str, object] = field(default_factory=dict)

    @property
    def wiring(self) -> SignalTopics:
        """Where its signals are on the wire."""
        wiring = preset_wiring(self.system, self.disturbances)
        assert wiring is not None
        return wiring


@dataclass(frozen=True)
class Row:
    """The values at one command, by signal and in their units."""

    seconds: float  #: plant time since the first measurement
    measured: Mapping[str, float]
    setpoints: Mapping[str, float]  #: tracked, as far as they are known
    commanded: Mapping[str, float]


class Operator:
    """
    Operate the loop that `harness` runs: set-points, services and parameters, phase by phase.

    Raises HarnessError if the loop rejects a step, or stops.
    """

    def __init__(self, scenario: Scenario, harness: Harness, on_row: Callable[[Row], None]
                 ) -> None:
        self.scenario = scenario
        self.harness = harness
        self.phases: list[tuple[str, float]] = []  # name and start in s
        self._on_row = on_row
        # several topics: any message of those with one stamp may come first
        self._measured: dict[int, dict[str, float]] = {}
        self._commanded: dict[int, dict[str, float]] = {}
        self._active: dict[str, float] = {}
        self.last_stamp_ns = 0
        self._wiring = wiring = scenario.wiring
        states, inputs = wiring.signals.states, wiring.signals.inputs
        self._setpoints: SignalPublisher | None = SignalPublisher(wiring.setpoints, states,
                                                                  self._publisher)
        self._listen(wiring.measured, states, partial(self._on_part, self._measured))
        self._listen(wiring.active_setpoints, states, lambda sample: self._active.update(
            sample.values), topics.LATCHED_QOS)
        self._commands = self._listen(
            wiring.commands, inputs, partial(self._on_part, self._commanded))

    def _publisher(self, topic: str, kind: Any) -> Publisher:
        return self.harness.node.create_publisher(kind, topic, topics.LOOP_QOS)

    def _listen(self, places: Mapping[str, MessageField], units: Mapping[str, str],
                on_sample: Callable[[SignalSample], None],
                qos: QoSProfile = topics.LOOP_QOS) -> SignalSubscriber:
        node = self.harness.node
        return SignalSubscriber(node, lambda topic, callback, kind: node.create_subscription(
            kind, topic, callback, qos), places, units, on_sample)

    @property
    def found_loop(self) -> bool:
        """Whether controller and trainer are running and subscribe to the set-points."""
        return self._commands.published() and self._setpoints is not None and all(
            publisher.get_subscription_count() >= 2 for publisher in self._setpoints.publishers)

    @property
    def seconds(self) -> float:
        """Plant time of the last command since the first measurement, in s; 0 before it."""
        return max(0.0, (self.last_stamp_ns - FIRST_STAMP_NS) / NANOSECONDS)

    def run_until(self, seconds: float) -> None:
        """Let the loop run until a plant time in s after its first measurement."""
        end = FIRST_STAMP_NS + seconds * NANOSECONDS
        while self.last_stamp_ns < end:
            self.harness.wait_until(partial(self._answered_after, self.last_stamp_ns),
                                    'the loop has stopped: no command was received')

    def _answered_after(self, stamp_ns: int) -> bool:
        return self.last_stamp_ns > stamp_ns

    def wait_for_recording(self) -> None:
        """
        Wait until the trainer has recorded the loop from its start to the last command received.

        Messages that reached the operator may still be on their way to the trainer, and are lost
        when either end of the connection is stopped.
        """
        samples = round(self.seconds / self.scenario.sample_period) + 1
        topics = [place.topic for place in (
            *self._wiring.measured.values(), *self._wiring.commands.values())]

        def missing() -> str:
            status = self.harness.last_status('trainer: recording')
            counts = {} if status is None else {item.key: item.value for item in status.values}
            lost = {topic: samples - int(counts.get(f'messages on /{topic}', 0))
                    for topic in topics}
            return ', '.join(f'{count} of {samples} messages on /{topic}'
                             for topic, count in lost.items() if count > 0)

        self.harness.wait_until(lambda: not missing(),
                                lambda: f'the recording lacks {missing()}: {BUSY}')

    def request_setpoints(self, setpoints: Mapping[str, float], seconds: float) -> None:
        """Publish set-points, stamped with the plant time in s from which they hold."""
        if self._setpoints is None:
            self._setpoints = SignalPublisher(
                self._wiring.setpoints, self._wiring.signals.states, self._publisher)
            self.harness.wait_until(lambda: self.found_loop,
                                    'no node subscribes to the set-points')
        stamp = FIRST_STAMP_NS + round(seconds * NANOSECONDS)
        wanted = [setpoints[name] for name in self._wiring.setpoints]
        self._setpoints.send(np.array(wanted), stamp_message(stamp), 'operator')

    def leave_setpoints(self) -> None:
        """Stop publishing the set-points, until they are requested again."""
        for publisher in [] if self._setpoints is None else self._setpoints.publishers:
            self.harness.node.destroy_publisher(publisher)
        self._setpoints = None

    def begin(self, name: str, text: str) -> None:
        """Begin a phase, and announce it."""
        self.phases.append((name, self.seconds))
        print(text, flush=True)

    def switch(self, service: str, on: bool) -> None:
        """Call a service that switches something on or off."""
        _check(service, self.harness.set_bool(service, on))

    def set(self, node: str, **values: object) -> None:
        """Set parameters of a node."""
        if reasons := self.harness.rejected_parameters(node, **values):
            raise HarnessError(f'{node}: {"; ".join(reasons)}')

    def record_again(self, bag: Path) -> None:
        """End the recording, and begin another one."""
        self.switch('trainer/record', False)
        self.set('trainer', output=str(bag))
        self.switch('trainer/record', True)

    def wait_for(self, task: str, words: str, timeout: float) -> DiagnosticStatus:
        """Wait until the status of a task of the trainer begins with some words."""
        def found() -> DiagnosticStatus | None:
            status = self.harness.last_status(f'trainer: {task}')
            if status is not None and status.level == DiagnosticStatus.ERROR:
                raise HarnessError(f'{task}: {status.message}')
            return status if status is not None and status.message.startswith(words) else None

        status = self.harness.wait_until(found, f'the {task} did not finish', timeout)
        assert status is not None
        return status

    def train(self, model: Path, timeout: float) -> None:
        """Let the trainer learn a model from its recording, and wait for it."""
        _check('trainer/train', self.harness.trigger('trainer/train'))
        status = self.wait_for('training', 'the new model', timeout)
        print(status.message, flush=True)
        if not model.exists():
            raise HarnessError(status.message)

    def _on_part(self, parts: dict[int, dict[str, float]], sample: SignalSample) -> None:
        """Take a message, and show the row that it makes whole."""
        stamp = sample.stamp_ns
        parts.setdefault(stamp, {}).update(sample.values)
        if (len(self._measured.get(stamp, ())) == len(self._wiring.measured)
                and len(self._commanded.get(stamp, ())) == len(self._wiring.commands)):
            self.last_stamp_ns = stamp
            self._on_row(Row((stamp - FIRST_STAMP_NS) / NANOSECONDS, self._measured.pop(stamp),
                             dict(self._active), self._commanded.pop(stamp)))


def _check(service: str, response: SetBool.Response | Trigger.Response) -> None:
    if not response.success:
        raise HarnessError(f'{service}: {response.message}')


def foreign(harness: Harness, wiring: SignalTopics) -> str:
    """
    Return which other nodes of the domain conflict with a loop that has not started, or ''.

    These are nodes of the names that the loop uses, publishers of its topics, and subscribers of
    its commands except tools such as `ros2 topic echo`.
    """
    node, deadline = harness.node, time.monotonic() + _DISCOVERY
    while time.monotonic() < deadline:
        harness.spin_once()
    used = {place.topic for kind in wiring.kinds for place in getattr(wiring, kind).values()}
    commands = {place.topic for place in wiring.commands.values()}
    names = [name for name, namespace in node.get_node_names_and_namespaces()
             if namespace == '/']
    present = [f'a node /{name}' for name in names if name in _NODES]
    if names.count(node.get_name()) > 1:
        present.append(f'another node /{node.get_name()}')
    for topic in sorted(used):
        present += [f'{topics.node_name(info)} publishes {topic}'
                    for info in node.get_publishers_info_by_topic(topic)]
    for topic in sorted(commands):
        present += [f'{topics.node_name(info)} subscribes to {topic}'
                    for info in node.get_subscriptions_info_by_topic(topic)
                    if not info.node_name.startswith('_ros2cli')]
    return ', '.join(dict.fromkeys(present))


@contextlib.contextmanager
def running_loop(scenario: Scenario, logs: Path, trainer: Mapping[str, object],
                 on_row: Callable[[Row], None] = lambda _: None,
                 panel: Mapping[str, object] | None = None) -> Iterator[Operator]:
    """
    Run plant, controller and trainer in lock-step, the set-points requested, until it is left.

    The ROS domain is that of ROS_DOMAIN_ID, where it is set, or else one that no other run uses.
    To be called from the main thread: it takes over Ctrl-C, so that the processes end.

    :param logs: folder for the output of the processes, which is created.
    :param trainer: parameters of the trainer, which records from its start.
    :param on_row: called at every command.
    :param panel: parameters of a panel, None for no panel.
    :raises HarnessError: when other nodes of the domain use the loop's topics or names, before
        anything is commanded; when a process ends early or the loop stops.
    """
    logs.mkdir(parents=True, exist_ok=True)
    with (deferred_interrupt() as check_interrupt,
          Harness(logs, name='operator', timeout=_TIMEOUT, lasting=True,
                  domain=os.environ.get('ROS_DOMAIN_ID', ''), each_turn=check_interrupt)
          as harness):
        domain = harness.environment['ROS_DOMAIN_ID']
        print(f'ROS domain {domain}', flush=True)
        if found := foreign(harness, scenario.wiring):
            raise HarnessError(
                f'ROS domain {domain} has other nodes with the names or topics of the demo: '
                f'{found}; stop them, or use another domain: '
                f'ROS_DOMAIN_ID={(int(domain) + 1) % 102} make demo')
        operator = Operator(scenario, harness, on_row)
        shared: dict[str, object] = {'system': scenario.system} | (
            {'disturbances_measured': list(scenario.disturbances)}
            if scenario.disturbances else {})
        harness.start('controller', {'system': scenario.system, **scenario.controller})
        harness.start('trainer', {**shared, **trainer})
        harness.wait_until(lambda: operator.found_loop,
                           'controller and trainer did not discover each other')
        if panel is not None:
            shown = harness.start('panel', {**shared, **panel})
            address = harness.wait_until(lambda: re.search(r'the panel is at (\S+)',
                                                           shown.output()))
            assert address is not None
            print(f'the panel is at {address[1]}', flush=True)
        if scenario.setpoints:
            operator.request_setpoints(scenario.setpoints, scenario.step_time)
        plant = harness.start('plant', {
            **shared, **scenario.plant,
            'lockstep': True, 'speed': scenario.speed, 'duration': scenario.duration,
            'sample_period': scenario.sample_period, 'start_time': _START_TIME,
            # controller, trainer and operator: none misses the first measurement
            'lockstep_subscribers': 3 if panel is None else 4,
        })
        # the others hear its last measurement
        with plant:
            yield operator
        if (code := plant.stop()) != 0:
            raise HarnessError(f'plant ended with code {code}: {plant.output()[-1000:]}')


def run_loop(scenario: Scenario, bag: Path, logs: Path,
             on_row: Callable[[Row], None] = lambda _: None) -> None:
    """Run a loop until the scenario's end, recorded whole by the trainer in a new bag."""
    with running_loop(scenario, logs, {'output': bag}, on_row) as operator:
        operator.run_until(scenario.duration)
        operator.wait_for_recording()
