# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining of the plants of many loops in one call, by the parameters of each loop's trainer."""

from collections.abc import Mapping, Sequence
from pathlib import Path
import sys
import time
from typing import Any

import rclpy

from koopman_ros.execution.training import JobState, TrainingJob, TrainingProgress
from koopman_ros.parameters.signal_topics import SIGNALS, SignalTopics
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.parameters.trainer import trainer_signals, trainer_table
from koopman_ros.ros.managed import one_line, START_ERRORS
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import init
from koopman_ros.ros.training import current_model, POLL_PERIOD, task_fields


def run_fleet(args: list[str] | None, file: str, arrived: Sequence[int]) -> int:
    """
    Retrain the plants of a file of loops, each by its trainer's parameters, until a signal.

    A line on standard output gives the result of each. Nothing is written of those that have not
    ended at a signal.

    :param arrived: signals, as they come.
    :return: exit code: 0 when all new lifts are accepted, 2 when one is rejected, 1 when a plant
        could not be retrained, or none could be tried.
    """
    # processes of many loops alone need it
    from koopman_ros.ros.host import read_loops

    tasks: dict[str, dict[str, Any]] = {}
    schedulers: dict[str, str] = {}
    failed = False
    try:
        loops = read_loops(Path(file))
        try:
            init(args)
            for namespace in loops:
                try:
                    tasks[namespace], schedulers[namespace] = _of_loop(namespace)
                except START_ERRORS as error:
                    failed = True
                    _say(namespace, f'cannot be retrained: {one_line(error)}')
        finally:
            rclpy.try_shutdown()
        scheduler = _one_scheduler(schedulers)
    except START_ERRORS as error:
        print(f'trainer: cannot start: {one_line(error)}', file=sys.stderr)
        return 1
    if not tasks:
        return 1
    end = _retrain({'plants': tasks, 'executor': scheduler}, arrived)
    return 1 if failed or not (end.accepted or end.rejected) else 0 if end.accepted else 2


def _of_loop(namespace: str) -> tuple[dict[str, Any], str]:
    """Return the fields of a plant's task, and its executor."""
    node = LoopNode('trainer', namespace=namespace, start_parameter_services=False,
                    enable_rosout=False)
    try:
        given = node.given()
        present = current_model(given)
        settings = node.declare_table(trainer_table(present, given))
        bags = list(filter(None, settings.bags))
        if not bags:
            raise ConfigurationError('no bag to train from: set bags')
        signals = trainer_signals(present, {name: getattr(settings, name) for name in SIGNALS})
        wiring = SignalTopics.of(signals, settings)
        return task_fields(node, settings, wiring, bags), settings.executor
    finally:
        node.destroy_node()


def _one_scheduler(schedulers: Mapping[str, str]) -> str:
    found = sorted(set(schedulers.values()))
    if len(found) > 1:
        raise ConfigurationError(
            f'executor is {" and ".join(map(repr, found))} in different loops: set the same one '
            'for all plants of a call, e.g. under /**')
    return found[0] if found else ''


def _retrain(task: Mapping[str, object], arrived: Sequence[int]) -> JobState:
    """Retrain in a child process; print the result of each plant as it ends."""
    job = TrainingJob(task)
    told: set[str] = set()
    progress = TrainingProgress(lambda text: print(text, file=sys.stderr, flush=True))
    try:
        while True:
            state = job.poll()
            for name in state.plants:
                if name not in told:
                    told.add(name)
                    # in the place of a bar
                    _say(f'\r\x1b[K{name}' if sys.stdout.isatty() else name,
                         state.plants[name].text)
            progress.show(state)
            if state.ended:
                print(f'trainer: {state.text}', flush=True)
                return state if not arrived else JobState(ended=True)
            if arrived:
                job.cancel()
            time.sleep(POLL_PERIOD)
    finally:
        job.close()


def _say(namespace: str, text: str) -> None:
    print(f'{namespace}: {text}', flush=True)
