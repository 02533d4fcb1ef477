# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Snapshot of a loop, which the pages show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from koopman_ros.panel.alarms import Alarm
from koopman_ros.panel.faceplates import (
    CONTROLLER,
    InputFaceplate,
    PLANT,
    StateFaceplate,
    TRAINER,
)
from koopman_ros.parameters.description import ParameterDescription

OK, WARN, ERROR = 0, 1, 2  #: levels of a status
PANEL = 'panel'  #: role of the panel itself, for its parameters
ROLES: Mapping[str, str] = MappingProxyType({role: role for role in (PLANT, CONTROLLER, TRAINER)})
CONTROL, REQUESTS = f'{CONTROLLER}: control', f'{CONTROLLER}: requests'
MEASUREMENTS, CONNECTIONS = f'{CONTROLLER}: measurements', f'{CONTROLLER}: connections'
TRAINING, RECORDING = f'{TRAINER}: training', f'{TRAINER}: recording'
EXPERIMENT = f'{TRAINER}: experiment'
LOST = 'connection lost'  #: message of a silent node


@dataclass(frozen=True)
class TaskStatus:
    """Last status of a task of a node."""

    name: str  #: node and task
    level: int  #: OK, WARN or ERROR
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SilentTopic:
    """A node without messages."""

    role: str
    since: float  #: wall time of its last message, or of the start of the panel
    seen: bool  #: whether there was any message


@dataclass(frozen=True)
class Snapshot:
    """Everything that the pages show, at one instant."""

    plant: str  #: its name
    wall: float  #: wall time
    time: float  #: stamp of the last measurement
    mode: str  #: automatic or manual, empty for unknown
    level: str  #: active control level in words
    fallback: bool  #: whether it is not the first one
    reason: str  #: of the fallback, in words
    states: tuple[StateFaceplate, ...]
    inputs: tuple[InputFaceplate, ...]
    estimates: tuple[tuple[str, str], ...]  #: unmeasured states with their values
    statuses: Mapping[str, TaskStatus]
    standing: tuple[Alarm, ...]  #: alarms, the most urgent first
    shelved: tuple[Alarm, ...]
    stale: frozenset[str]  #: keys of alarms whose nodes no longer report them
    silences: tuple[SilentTopic, ...]
    parameters: Mapping[str, Mapping[str, ParameterDescription]]  #: by role
    model: Mapping[str, str]  #: origin and held-out figures of the current model
    previous_model: str  #: active before, or empty

    def status(self, name: str) -> TaskStatus:
        """Return the status of a task: empty for none, an error for a silent node."""
        found = self.statuses.get(name, TaskStatus(name, OK, ''))
        lost = any(one.seen and one.role == name.partition(':')[0] != PLANT
                   for one in self.silences)
        return replace(found, level=ERROR, message=LOST) if lost else found

    @property
    def experiment(self) -> str:
        """Time left of an experiment that runs, in s; empty for none."""
        left = self.status(EXPERIMENT).values.get('left [s]', '0')
        return '' if left == '0' or self.silent(TRAINER) else left

    @property
    def obstacle(self) -> str:
        """Why the loop cannot be operated, or empty."""
        silent = [role for role in (PLANT, CONTROLLER) if self.silent(role)]
        return f'no message from the {" and the ".join(silent)}' if silent else ''

    def silent(self, role: str) -> bool:
        """Return whether a node sends nothing."""
        return any(one.role == role for one in self.silences)

    def parameter(self, role: str, name: str) -> Any:
        """Return the value of a parameter of a node, None for an unknown one."""
        found = self.parameters.get(role, {}).get(name)
        return found and found.value
