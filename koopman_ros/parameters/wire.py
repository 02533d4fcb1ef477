# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Names of the topics of the loop, and what its messages have room for."""

from collections.abc import Collection

TEMPERATURE = 'temperature'
CONCENTRATION = 'concentration'
SETPOINT = 'setpoint'
ACTIVE_SETPOINT = 'active_setpoint'
COOLANT_SETPOINT = 'coolant_setpoint'
COOLANT_TEMPERATURE = 'coolant_temperature'
MANUAL_COOLANT_SETPOINT = 'manual_coolant_setpoint'
PREDICTED_TEMPERATURE = 'predicted_temperature'
CONTROLLER_STATE = 'controller_state'
CONTROLLER_EVENTS = 'controller_events'
DIAGNOSTICS = '/diagnostics'
CLOCK = '/clock'

LONGEST_FRAME_ID = 256  # characters that are passed on


def refusal(names: Collection[str]) -> str:
    """Say why a list of names cannot be that of topics, or return an empty string."""
    return '' if names and all(names) else (
        f'topics = {list(names)} must hold at least one name and no empty one')
