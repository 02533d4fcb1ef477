# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A day of plant time with whatever may happen in one: nothing is lost, and nothing grows."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
import math
from pathlib import Path
import shutil
import signal
import time

import numpy as np
from numpy.random import default_rng, Generator
from sensor_msgs.msg import Temperature

from koopman_ros.arrays import Array
from koopman_ros.bags import summary
from koopman_ros.testing import HarnessError
from validation.faults import interceptor
from validation.faults.case import LOCKSTEP, SETPOINT, Trace
from validation.faults.harness import FaultHarness
from validation.faults.interceptor import Alteration, value
from validation.faults.judge import out_of_range, Responses, responses

HOURS = 24.0
_SEED = 0
_EVENT_PERIOD = 300.0  # s, mean time between two events
_WALL_PER_HOUR = 240.0  # s, at most
_LOOKS = 200  # at the memory
_WARM = 0.25  # share of the run after which memory is to be flat
_GROWTH = 4.0  # MB that a process may grow from then on
_RECORDED = ('temperature', 'coolant_setpoint')
_MEGABYTE = 1e6


@dataclass(frozen=True)
class Memory:
    """The resident memory of a process over the run."""

    seconds: Array  #: (N,) plant time
    megabytes: Array  #: (N,) resident

    @property
    def growth(self) -> float:
        """By how much it grows by a straight line from when the process is warm, MB."""
        warm = self.seconds >= _WARM * self.seconds[-1]
        if np.count_nonzero(warm) < 3:
            return 0.0
        # from the first on, so that what does not grow is exactly 0
        since = self.megabytes[warm] - self.megabytes[warm][0]
        slope = np.polyfit(self.seconds[warm], since, 1)[0]
        return float(slope * np.ptp(self.seconds[warm])) + 0.0


@dataclass(frozen=True)
class Endurance:
    """What an endurance run found."""

    reasons: tuple[str, ...]  #: what is held against it, in sentences
    hours: float  #: of plant time
    wall: float  #: what it took, s
    answers: Responses  #: how measurements were answered
    events: dict[str, int]  #: how often each happened
    memory: dict[str, Memory]  #: by process
    recorded: dict[str, int]  #: messages in the bag by topic
    hottest: float  #: the highest true temperature, degC
    mean_error: float  #: mean |T - set-point| in K


# What may happen in a day: faults of messages, requests, disturbances; each ends by itself.


def _alter(loop: FaultHarness, random: Generator, what: str, make: Callable[[], Alteration]
           ) -> None:
    loop.alter(float(random.uniform(2.0, 60.0)), **{what: make()})


def _ask(loop: FaultHarness, random: Generator) -> None:
    loop.request(float(random.uniform(42.0, 50.0)))


def _ask_for_too_much(loop: FaultHarness, random: Generator) -> None:
    celsius = float(random.choice([math.nan, 90.0, -1e9]))
    loop.setpoint.publish(Temperature(temperature=celsius))


def _disturb(loop: FaultHarness, random: Generator) -> None:
    loop.set_parameters(
        'plant', feed_temperature=float(random.uniform(74.0, 80.0)),
        heat_transfer_coefficient=float(random.uniform(45000.0, 55000.0)),
        noise=float(random.uniform(0.0, 0.05)))


def _retune(loop: FaultHarness, random: Generator) -> None:
    loop.set_parameters(
        'controller', coolant_weight=float(10.0 ** random.uniform(-1.0, 1.0)),
        temperature_weight=float(random.choice([1.0, math.nan])))


def _by_hand(loop: FaultHarness, random: Generator) -> None:
    loop.ros.set_bool('controller/set_automatic', False)
    loop.run_for(float(random.uniform(5.0, 60.0)))
    loop.ros.set_bool('controller/set_automatic', True)


def _other_model(loop: FaultHarness, random: Generator) -> None:
    loop.set_parameters('controller', model=str(random.choice(
        ['reactor_nz3', 'reactor_nz4', '/nowhere.safetensors'])))
    loop.ros.trigger('controller/reload_model')


def _reset(loop: FaultHarness, _: Generator) -> None:
    loop.ros.trigger('plant/reset')


_ON_THE_WAY: dict[str, Callable[[], Alteration]] = {
    'lost': lambda: interceptor.lost(0.5), 'late': lambda: interceptor.delayed(3),
    'doubled': lambda: interceptor.twice}
_MEASURED: dict[str, Callable[[], Alteration]] = {
    'NaN': lambda: value(lambda *_: math.nan), '200 degC': lambda: value(lambda *_: 200.0),
    'spike': lambda: value(lambda _, shown: shown + 15.0), 'frozen': interceptor.frozen,
    'noise of 1 K': lambda: interceptor.noise(1.0), **_ON_THE_WAY}
EVENTS: list[tuple[str, Callable[[FaultHarness, Generator], None]]] = [
    *((f'{what}: {name}', partial(_alter, what=what, make=make)) for what, makers in (
        ('measurements', _MEASURED), ('commands', _ON_THE_WAY)) for name, make in makers.items()),
    # what an operator does, and the weather, come more often
    *4 * [('set-point', _ask), ('disturbance', _disturb)],
    ('impossible set-point', _ask_for_too_much), ('weights', _retune), ('manual mode', _by_hand),
    ('model', _other_model), ('plant reset', _reset)]


def run_endurance(folder: Path, check: Callable[[], None], hours: float = HOURS) -> Endurance:
    """
    Run plant, controller and trainer for some hours of plant time, and account for everything.

    :param folder: for the bag, which is deleted afterwards, and for what the processes print.
    :param check: called all the time; may raise to end it.
    """
    started = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    happened: Counter[str] = Counter()
    looks: dict[str, list[tuple[float, float]]] = {}
    with FaultHarness(folder, 60.0 + _WALL_PER_HOUR * hours, check, between=True) as loop:
        try:
            loop.start('trainer', {'output': folder / 'bag', 'min_free_disk': 0.0,
                                   'topics': _RECORDED})
            loop.start_loop(SETPOINT, LOCKSTEP, {})
            _let_happen(loop, hours, happened, looks)
            # what is on its way arrives, so that the counts can agree
            loop.kill('plant', signal.SIGINT)
            loop.wait(lambda: len(loop.trace.commands) >= len(loop.trace.delivered),
                      'measurements are left without an answer')
            sent = len(loop.trace.commands) + len(loop.trace.delivered)
            loop.wait(lambda: (status := loop.trace.last('trainer: recording')) is not None
                      and int(status.values.get('messages', 0)) >= sent,
                      'the trainer has not recorded all messages')
        except HarnessError as error:
            loop.trace.complaints.append(str(error))
    bag, recorded = folder / 'bag', {}
    if bag.exists():
        recorded = dict(summary(bag).counts)
        shutil.rmtree(bag)
    memory = {name: Memory(*np.array(seen).T) for name, seen in looks.items()}
    trace = loop.trace
    answers = responses(trace.delivered, [command.stamp_ns for command in trace.commands])
    return Endurance(
        tuple(_held_against(trace, answers, memory, recorded)), hours,
        time.monotonic() - started, answers, dict(happened), memory, recorded,
        max((sample.celsius for sample in trace.samples), default=math.nan),
        float(np.mean(trace.errors()[1])) if trace.samples else math.nan)


def _let_happen(loop: FaultHarness, hours: float, happened: Counter[str],
                looks: dict[str, list[tuple[float, float]]]) -> None:
    """Run for so long; count the events, and note each process's memory by plant time."""
    random = default_rng(_SEED)
    look = 3600.0 * hours / _LOOKS
    due = loop.now + random.exponential(_EVENT_PERIOD)
    for number in range(1, _LOOKS + 1):
        while due < number * look:
            loop.run_until(due)
            name, play = EVENTS[random.integers(len(EVENTS))]
            happened[name] += 1
            play(loop, random)
            due = loop.now + random.exponential(_EVENT_PERIOD)
        loop.run_until(number * look)
        for name, process in loop.processes.items():
            looks.setdefault(name, []).append((loop.now, _resident(process.process.pid)))
        print(f'\rsoak: {number / _LOOKS * hours:5.1f} of {hours:g} h ', end='', flush=True)


def _resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    kilobytes = next(line.split()[1] for line in lines if line.startswith('VmRSS'))
    return int(kilobytes) * 1024 / _MEGABYTE


def _held_against(trace: Trace, answers: Responses, memory: dict[str, Memory],
                  recorded: dict[str, int]) -> Iterator[str]:
    yield from trace.complaints
    if not answers.complete:
        yield (f'of {answers.measurements} measurements {answers.unanswered} were not answered; '
               f'{answers.repeated} answers were repeated, {answers.unasked} unasked, '
               f'{answers.out_of_order} out of order')
    yield from out_of_range(trace)
    for name, seen in memory.items():
        if not seen.growth <= _GROWTH:
            yield (f'{name} grew by {seen.growth:.1f} MB after it was warm, {_GROWTH:g} MB are '
                   'allowed')
    for topic, sent in (('/temperature', len(trace.delivered)),
                        ('/coolant_setpoint', len(trace.commands))):
        if recorded.get(topic) != sent:
            yield f'the bag holds {recorded.get(topic, 0)} of {sent} messages on {topic}'
