# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the model does not know: a plant that changes, an actuator that is slow or stuck."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from koopman_ros.parameters.controller import ControllerParameters
from validation.faults.case import Case
from validation.faults.rig import LOCKSTEP, Rig

GROUP = 'disturbances'
STUCK_AT = 25.0  # degC; the set-point needs 23.4 degC, and the reactor gets 2.1 K too warm
WINDUP = 3.0  # K; who has wound up meanwhile goes further to the other side
CONCENTRATION = 0.87725294608097  # mol/L, that of the plant


def _changed(**parameters: float) -> Callable[[Rig], None]:
    """Return the play that changes the plant for good."""
    def play(rig: Rig) -> None:
        rig.begin()
        reasons = rig.operator.set_parameters('plant', **parameters)
        rig.expect(not any(reasons), f'the plant was not changed: {reasons}')
        rig.end()

    return play


def _changed_in_a_step(**parameters: float) -> Callable[[Rig], None]:
    def play(rig: Rig) -> None:
        rig.operator.ask(42.0)
        _changed(**parameters)(rig)

    return play


def _saturated(rig: Rig) -> None:
    rig.begin()
    rig.operator.set_parameters('plant', coolant_min=STUCK_AT)
    rig.run_for(900.0)
    rig.operator.set_parameters('plant', coolant_min=-20.0)
    rig.end()


def _limited(rig: Rig) -> None:
    rig.begin()
    rig.operator.set_parameters('controller', coolant_min=STUCK_AT)
    rig.run_for(900.0)
    rig.operator.set_parameters('controller', coolant_min=ControllerParameters.coolant_min)
    rig.end()


def _constant(name: str, does: str, play: Callable[[Rig], None], **details: Any) -> Case:
    return Case(name, GROUP, does, play,
                **{'recovery': 360.0, 'afterwards': 600.0, 'offset': 0.01, **details})


CASES = (
    _constant('heat-transfer-low', 'UA -20 %, for good',
              _changed(heat_transfer_coefficient=40000.0)),
    _constant('heat-transfer-high', 'UA +20 %, for good',
              _changed(heat_transfer_coefficient=60000.0)),
    _constant('feed-warm', 'T_i +5 K, for good', _changed(feed_temperature=81.85)),
    _constant('feed-cold', 'T_i -5 K, for good', _changed(feed_temperature=71.85)),
    _constant('concentration-high', 'C_A +10 %, for good',
              _changed(concentration=1.1 * CONCENTRATION)),
    _constant('concentration-low', 'C_A -10 %, for good',
              _changed(concentration=0.9 * CONCENTRATION)),
    _constant('actuator-lag', 'the coolant follows its command with 5 s, for good, and the '
              'set-point steps', _changed_in_a_step(coolant_lag=5.0)),
    _constant('actuator-late', 'commands act one sample late, for good, and the set-point steps',
              _changed_in_a_step(command_delay=1.0)),
    _constant('actuator-saturated', f'the coolant does not get below {STUCK_AT:g} degC, 15 min',
              _saturated, worst=WINDUP),
    _constant('coolant-limited', f'the controller may not command less than {STUCK_AT:g} degC, '
              '15 min', _limited, worst=WINDUP),
    _constant('noise', 'noise of 0.1 K, for good', _changed(noise=0.1), band=0.5, offset=0.5),
    _constant('two-state', 'the concentration moves, which the model does not know, and the feed '
              'gets 1 K warmer; near the stable point', _changed(feed_temperature=77.85),
              setpoint=50.5, plant={**LOCKSTEP, 'reactor': 'two_state'}),
)
