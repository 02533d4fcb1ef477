# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What a controller remembers between two measurements."""

from dataclasses import dataclass, field
from enum import Enum
from typing import TypeVar

import numpy as np

from koopman_ros.arrays import Array
from koopman_ros.control.setpoint import Setpoint
from koopman_ros.control.supervisor import Supervisor
from koopman_ros.control.transfer import Transfer
from koopman_ros.control.way_back import WayBack
from koopman_ros.estimation import Accepted, Estimate

Record = TypeVar('Record')


def amended(record: Record, **changes: object) -> Record:
    """
    Return a copy of a frozen dataclass with other values, as :func:`dataclasses.replace` does.

    It is a fifth of a control step faster, since it neither asks for the fields nor checks
    values: for records without checks of their own.
    """
    copy: Record = object.__new__(type(record))
    copy.__dict__.update(record.__dict__)
    copy.__dict__.update(changes)
    return copy


class Mode(Enum):
    """Who commands the input; the value is the word an operator reads."""

    AUTOMATIC = 'automatic'
    MANUAL = 'manual'


@dataclass(frozen=True)
class State:
    """All that a controller remembers between two measurements."""

    mode: Mode = Mode.AUTOMATIC  #: who commands
    #: requested, active and scheduled set-points
    setpoint: Setpoint = field(default_factory=Setpoint)
    #: (n_u,) what the operator asked for in manual mode, or None
    manual_input: Array | None = None
    time_ns: int | None = None  #: stamp of the last measurement, or None before the first
    command: Array | None = None  #: (n_u,) last command, or None before the first
    commanded_ns: int | None = None  #: when it was given, or None
    interval: float = np.inf  #: usual seconds between measurements; infinity before the second
    accepted: Accepted | None = None  #: what is remembered of the measurements
    #: state and disturbance, in the deviations of the acting level's model
    estimate: Estimate | None = None
    supervisor: Supervisor = field(default_factory=Supervisor)  #: which level acts
    #: from the safe input, while it is applied where no law may act, or None
    way_back: WayBack | None = None
    law: str | None = None  #: the level whose law gave the last command; None when none did
    law_input: Array | None = None  #: (n_u,) what that law asked for, within the range
    law_memory: object = None  #: what that law remembers
    transfer: Transfer | None = None  #: what is added to it for a while, or None
