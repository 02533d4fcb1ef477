# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The cases of the campaign, by group."""

from studies.faults.cases import (
    any_plant,
    messages,
    operators,
    processes,
    saddle,
    silent_failures,
)

CASES = {case.name: case for case in (
    *messages.CASES, *processes.CASES, *operators.CASES, *any_plant.CASES, *saddle.CASES,
    *silent_failures.CASES)}
