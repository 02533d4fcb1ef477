# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The cases of the campaign, by group."""

from validation.faults.case import Case
from validation.faults.cases import (
    clocks,
    disturbances,
    messages,
    neighbours,
    operators,
    processes,
    sensor,
)

CASES: dict[str, Case] = {
    case.name: case
    for group in (sensor, messages, clocks, processes, operators, neighbours, disturbances)
    for case in group.CASES}

__all__ = ['CASES']
