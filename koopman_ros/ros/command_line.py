# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a program of the package says to arguments that are not ROS's."""

from __future__ import annotations

from dataclasses import dataclass
import os
import sys

from rclpy.utilities import remove_ros_args

_UNKNOWN = 2  # exit code, that of argparse


@dataclass(frozen=True)
class _Program:
    """
    What the help says of a program beside its topics and parameters.

    :param does: a sentence.
    :param codes: meaning of its exit codes.
    """

    does: str
    codes: str


_NODE_CODES = '0 after a signal, 1 when it cannot start, 2 for an unknown argument'
PROGRAMS = {
    'plant': _Program(
        'Simulates the reactor: publishes its temperature and takes a coolant temperature.',
        _NODE_CODES),
    'controller': _Program(
        'Answers each measured temperature with a coolant set-point, by a learned model.',
        _NODE_CODES),
    'trainer': _Program(
        'Records the loop to MCAP bags, excites the plant, and learns models from bags.',
        f'{_NODE_CODES}; with task:=train 0 for an accepted model, 2 for a refused one, 1 for a '
        'failure'),
    'player': _Program(
        'Publishes the measurements and set-points of a bag again, by the clock or in lock-step.',
        '0 when all was played or after a signal, 1 when it cannot start or go on, 2 for an '
        'unknown argument'),
    'replay': _Program(
        'Takes the records in bags through the control step again, also with a new model.',
        '0 when the recorded commands are reproduced, 1 when not or when it cannot run, 2 for an '
        'unknown argument, 3 when there is nothing to compare in a bag, 130 when interrupted'),
}


def answer(name: str, args: list[str] | None) -> int | None:
    """
    Print the help that is asked for, or refuse what is not ROS's.

    :param name: of the program.
    :param args: command line, or None for the process's own.
    :return: exit code, or None for a program that is to run.
    """
    try:
        rest = remove_ros_args(args)[1:]
    except RuntimeError:
        # the start says what is wrong with them
        return None
    if not rest:
        return None
    if '--help' in rest or '-h' in rest:
        _show(help_text(name))
        return 0
    print(f'{name}: unknown argument {rest[0][:100]!r}: parameters are given as --ros-args -p '
          'name:=value; --help says more', file=sys.stderr)
    return _UNKNOWN


def _show(text: str) -> None:
    """Print a text to whoever reads it; `--help | head` stops half-way."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # the interpreter flushes once more when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def help_text(name: str) -> str:
    """Return what `--help` prints."""
    # they import the tables of all nodes
    from koopman_ros.resources import config_directory
    from koopman_ros.ros.access import NODES, STANDARD_SERVICES, STANDARD_TOPICS
    from koopman_ros.ros.parameter_files import TABLES

    program = PROGRAMS[name]
    rows = TABLES[name].rows.values()
    width = max(len(row.name) for row in rows)
    parameters = '\n'.join(
        f'  {row.name:{width}}  {row.description}' + (f' [{row.unit}]' if row.unit else '')
        for row in rows)
    lists = ''.join(
        f'{title}: {", ".join(own)}\n' for title, names in (
            ('subscribes to', NODES[name].subscribes), ('publishes', NODES[name].publishes),
            ('serves', NODES[name].serves))
        if (own := [item for item in names if item not in STANDARD_TOPICS + STANDARD_SERVICES]))
    return f"""\
usage: ros2 run koopman_ros {name} [--ros-args [-p name:=value ...] [--params-file file] ...]

{program.does}

{lists}exit codes: {program.codes}

Parameters, whose defaults and ranges are in {config_directory() / f'{name}.yaml'}:
{parameters}"""
