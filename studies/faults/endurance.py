# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A day of plant time with whatever may happen in one: nothing is lost, and nothing grows."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
import math
from pathlib import Path
import shutil
import signal
import time
from typing import Any

import numpy as np
from numpy.random import default_rng, Generator

from koopman_ros.core.arrays import Array
from koopman_ros.records import summary
from koopman_ros.testing import HarnessError
from studies.faults import interceptor
from studies.faults.case import LoopTrace
from studies.faults.harness import FaultHarness
from studies.faults.interceptor import Alteration, value
from studies.faults.judge import out_of_range, responses
from studies.faults.plants import FaultPlant, HEATED_LINE, LOCKSTEP, REACTOR, SADDLE

HOURS = 24.0
_EVENT_PERIOD = 300.0  # s, mean time between two events
_WALL_PER_HOUR = 240.0  # s, at most
_LOOKS = 200  # at the memory
_WARM = 0.25  # share of the run after which memory is to be flat
_GROWTH = 4.0  # MB that a process may grow from then on


@dataclass(frozen=True)
class Day:
    """The loops of the run, and the ranges of their set-points and constants."""

    on: FaultPlant
    setpoints: tuple[float, float]
    plant: Mapping[str, tuple[float, float]]  #: parameters of the plant
    models: tuple[str, ...]  #: one of which there is not
    #: longest manual mode, in s, in which no law controls the plant
    manual: float = 60.0
    faults: tuple[str, ...] = ()  #: of its other messages, that may happen, too


DAYS = {
    'soak': Day(REACTOR, (42.0, 50.0), {
        'constants.feed_temperature': (74.0, 80.0),
        'constants.heat_transfer_coefficient': (750.0, 917.0),
        'temperature.measurement_noise': (0.0, 0.05)},
        ('reactor_nz3', 'reactor_nz4', '/nowhere.safetensors')),
    # what the coolant can make up for at once
    'soak-saddle': Day(SADDLE, (73.0, 81.0), {
        'constants.feed_temperature': (74.0, 80.0),
        'constants.heat_transfer_coefficient': (800.0, 870.0),
        'temperature.measurement_noise': (0.02, 0.08)},
        ('two_state_saddle', '/nowhere.safetensors'), manual=15.0),
    'soak-line': Day(HEATED_LINE, (44.0, 60.0), {
        'constants.feed_temperature': (14.0, 26.0),
        'constants.heat_transfer_coefficient': (2700.0, 3300.0),
        'temperature.measurement_noise': (0.0, 0.05), 'valve.dead_time': (32.0, 58.0)},
        ('heated_line', '/nowhere.safetensors'), faults=tuple(
            f'{what}: {alteration}' for what in ('disturbances', 'late')
            for alteration in ('NaN', 'lost', 'late', 'doubled')))}


def _happen(event: str, day: Day, loop: FaultHarness, random: Generator) -> None:
    """Events that may happen in a day: each ends without help."""
    what, _, alteration = event.partition(': ')
    match event:
        case 'set-point':
            loop.request(float(random.uniform(*day.setpoints)))
        case 'disturbance':
            loop.set_parameters('plant', **{
                name: float(random.uniform(*ends)) for name, ends in day.plant.items()})
        case 'impossible set-point':
            celsius = float(random.choice([math.nan, 190.0, -1e9]))
            loop.ask(temperature=celsius)
        case 'weights':
            name = f'{day.on.inputs[0]}.weight'
            loop.ros.rejected_parameters('controller', **{
                name: day.on.default(name) * float(10.0 ** random.uniform(-1.0, 1.0)),
                'temperature.weight': float(random.choice([1.0, math.nan]))})
        case 'manual mode':
            loop.ros.set_bool('controller/set_automatic', False)
            loop.run_for(float(random.uniform(5.0, day.manual)))
            loop.ros.set_bool('controller/set_automatic', True)
        case 'model':
            loop.ros.rejected_parameters('controller', model=str(random.choice(day.models)))
            loop.ros.trigger('controller/reload_model')
        case 'plant reset':
            loop.ros.trigger('plant/reset')
        case _:
            seconds = float(random.uniform(2.0, 60.0))
            loop.alter(seconds, **{what: ALTERATIONS[alteration]()})


ALTERATIONS: dict[str, Callable[[], Alteration]] = {
    'NaN': lambda: value(lambda *_: math.nan), '200 degC': lambda: value(lambda *_: 200.0),
    'spike': lambda: value(lambda _, shown: shown + 15.0), 'frozen': interceptor.frozen,
    'noise of 1 K': lambda: interceptor.noise(1.0), 'lost': lambda: interceptor.lost(0.5),
    'late': lambda: interceptor.delayed(3), 'doubled': lambda: interceptor.twice}
EVENTS = (
    *(f'measurements: {name}' for name in ALTERATIONS),
    *(f'commands: {name}' for name in ('lost', 'late', 'doubled')),
    # what an operator does, and the weather, come more often
    *4 * ('set-point', 'disturbance'),
    'impossible set-point', 'weights', 'manual mode', 'model', 'plant reset')


def run_endurance(folder: Path, check: Callable[[], None], hours: float = HOURS,
                  day: Day = DAYS['soak']) -> dict[str, Any]:
    """
    Run plant, controller and trainer for some hours of plant time, and account for everything.

    :param folder: for the bag, which is deleted afterwards, and for the output of the processes.
    :param check: called all the time; may raise to end it.
    :return: figures by name, among them the `reasons` held against it, in sentences.
    """
    started = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    happened: Counter[str] = Counter()
    looks: dict[str, list[tuple[float, float]]] = {}
    with FaultHarness(folder, 60.0 + _WALL_PER_HOUR * hours, check, True, day.on) as loop:
        try:
            loop.start('trainer', {'output': folder / 'bag', 'min_free_disk': 0.0,
                                   'topics': _recorded(day.on)})
            loop.start_loop(day.on.setpoint, LOCKSTEP, {})
            _let_happen(loop, day, hours, happened, looks)
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
    trace = loop.trace
    answers = responses(trace.delivered, [command.stamp_ns for command in trace.commands])
    memory = {name: {'first': round(seen[0][1], 2), 'last': round(seen[-1][1], 2),
                     'growth_when_warm': round(growth(*np.array(seen).T), 3)}
              for name, seen in looks.items()}
    reasons = list(_held_against(trace, answers, memory, recorded))
    hottest = max((celsius for _, (celsius,) in trace.samples), default=math.nan)
    mean_error = float(np.mean(trace.errors()[1])) if trace.samples else math.nan
    return {'survived': not reasons, 'reasons': reasons, 'hours': hours,
            'wall_seconds': round(time.monotonic() - started, 1), 'answers': answers,
            'events': dict(happened), 'recorded': recorded, 'hottest_degC': round(hottest, 6),
            'mean_error_K': round(mean_error, 6), 'memory_MB': memory}


def _recorded(on: FaultPlant) -> tuple[str, str]:
    """Return the topics of the measured state and of the input."""
    wiring = on.wiring
    return wiring.measured[on.states[0]].topic, wiring.commands[on.inputs[0]].topic


def _let_happen(loop: FaultHarness, day: Day, hours: float, happened: Counter[str],
                looks: dict[str, list[tuple[float, float]]]) -> None:
    """Run for so long; count the events, and note each process's memory by plant time."""
    random = default_rng(0)
    look = 3600.0 * hours / _LOOKS
    due = loop.now + random.exponential(_EVENT_PERIOD)
    for number in range(1, _LOOKS + 1):
        while due < number * look:
            loop.run_until(due)
            events = EVENTS + day.faults
            event = events[random.integers(len(events))]
            happened[event] += 1
            _happen(event, day, loop, random)
            due = loop.now + random.exponential(_EVENT_PERIOD)
        loop.run_until(number * look)
        for name, process in loop.processes.items():
            looks.setdefault(name, []).append((loop.now, _resident(process.process.pid)))
        print(f'\rsoak: {number / _LOOKS * hours:5.1f} of {hours:g} h ', end='', flush=True)


def _resident(pid: int) -> float:
    """Return the resident memory of a process in megabytes of 1e6 bytes."""
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    kilobytes = next(line.split()[1] for line in lines if line.startswith('VmRSS'))
    return int(kilobytes) * 1024 / 1e6


def growth(seconds: Array, megabytes: Array) -> float:
    """Return by how much a process grows by a straight line from when it is warm, in MB."""
    warm = seconds >= _WARM * seconds[-1]
    if np.count_nonzero(warm) < 3:
        return 0.0
    # from the first on, so that what does not grow is exactly 0
    slope = np.polyfit(seconds[warm], megabytes[warm] - megabytes[warm][0], 1)[0]
    return float(slope * np.ptp(seconds[warm])) + 0.0


def _held_against(trace: LoopTrace, answers: dict[str, int], memory: dict[str, dict[str, float]],
                  recorded: dict[str, int]) -> Iterator[str]:
    yield from trace.complaints
    wrong = ('unanswered', 'repeated', 'unasked', 'out_of_order')
    if any(answers[name] for name in wrong):
        yield f'of {answers["measurements"]} measurements or their answers were ' + ', '.join(
            f'{answers[name]} {name.replace("_", " ")}' for name in wrong)
    yield from out_of_range(trace)
    for name, seen in memory.items():
        if not seen['growth_when_warm'] <= _GROWTH:
            yield (f'{name} grew by {seen["growth_when_warm"]:.1f} MB after it was warm, '
                   f'{_GROWTH:g} MB are allowed')
    for topic, sent in zip(_recorded(trace.on), (len(trace.delivered), len(trace.commands)),
                           strict=True):
        if recorded.get(f'/{topic}') != sent:
            yield f'the bag holds {recorded.get(f"/{topic}", 0)} of {sent} messages on /{topic}'
