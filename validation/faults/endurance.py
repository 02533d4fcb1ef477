# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A day of plant time with whatever may happen in one: nothing is lost, and nothing grows."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import math
from pathlib import Path
import shutil
import signal
import time

import numpy as np

from koopman_ros.bags import summary
from koopman_ros.testing import HarnessError
from validation.faults.events import EVENTS
from validation.faults.harness import FaultHarness, LOCKSTEP
from validation.faults.judge import Bounds, out_of_range, Responses, responses, RUNAWAY
from validation.faults.trace import Array, Trace

HOURS = 24.0
SEED = 0
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


def run_endurance(folder: Path, check: Callable[[], None], hours: float = HOURS,
         on_progress: Callable[[float], None] = lambda _: None) -> Endurance:
    """
    Run plant, controller and trainer for some hours of plant time, and account for everything.

    :param folder: for the bag, which is deleted afterwards, and for what the processes print.
    :param check: called all the time; may raise to end it.
    :param on_progress: called with the share that is done.
    """
    started = time.monotonic()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    random = np.random.default_rng(SEED)
    happened: Counter[str] = Counter()
    looks: dict[str, list[tuple[float, float]]] = {}
    loop = FaultHarness(folder, 60.0 + _WALL_PER_HOUR * hours, check, between=True)
    with loop:
        try:
            loop.start('trainer', {'output': folder / 'bag', 'min_free_disk': 0.0,
                                  'topics': _RECORDED})
            loop.start_loop(46.0, LOCKSTEP, {})
            _let_happen(loop, 3600.0 * hours, random, happened, looks, on_progress)
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
    hottest = max((sample.celsius for sample in trace.samples), default=math.nan)
    return Endurance(tuple(_held_against(trace, answers, memory, recorded, hottest)), hours,
                time.monotonic() - started, answers, dict(happened), memory, recorded, hottest,
                float(np.mean(trace.errors()[1])) if trace.samples else math.nan)


def _let_happen(loop: FaultHarness, until: float, random: np.random.Generator,
                happened: Counter[str], looks: dict[str, list[tuple[float, float]]],
                on_progress: Callable[[float], None]) -> None:
    look = until / _LOOKS
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
        on_progress(number / _LOOKS)


def _resident(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    kilobytes = next(line.split()[1] for line in lines if line.startswith('VmRSS'))
    return int(kilobytes) * 1024 / _MEGABYTE


def _held_against(trace: Trace, answers: Responses, memory: dict[str, Memory],
                  recorded: dict[str, int], hottest: float) -> Iterator[str]:
    yield from trace.complaints
    if not answers.complete:
        yield (f'of {answers.measurements} measurements {answers.unanswered} were not answered; '
               f'{answers.repeated} answers were repeated, {answers.unasked} unasked, '
               f'{answers.out_of_order} out of order')
    yield from out_of_range(trace, Bounds())
    if not hottest < RUNAWAY:
        yield f'the reactor reached {hottest:.1f} degC'
    for name, seen in memory.items():
        if not seen.growth <= _GROWTH:
            yield (f'{name} grew by {seen.growth:.1f} MB after it was warm, {_GROWTH:g} MB are '
                   'allowed')
    for topic, sent in (('/temperature', len(trace.delivered)),
                         ('/coolant_setpoint', len(trace.commands))):
        if recorded.get(topic) != sent:
            yield f'the bag holds {recorded.get(topic, 0)} of {sent} messages on {topic}'
