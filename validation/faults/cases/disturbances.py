# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the model does not know: a plant that changes, an actuator that is slow or stuck."""

from collections.abc import Callable
from typing import Any

from koopman_ros.parameters.controller import ControllerParameters
from validation.faults.case import Case, case
from validation.faults.harness import FaultHarness, LOCKSTEP

GROUP = 'disturbances'
STUCK_AT = 25.0  # degC; the set-point needs 23.4 degC, and the reactor gets 2.1 K too warm
WINDUP = 3.0  # K; who has wound up meanwhile goes further to the other side
CONCENTRATION = 0.87725294608097  # mol/L, that of the plant


def _changed(**parameters: float) -> Callable[[FaultHarness], None]:
    """Return the play that changes the plant for good."""
    def play(loop: FaultHarness) -> None:
        loop.begin()
        reasons = loop.set_parameters('plant', **parameters)
        loop.expect(not reasons, f'the plant was not changed: {reasons}')
        loop.end()

    return play


def _changed_in_a_step(**parameters: float) -> Callable[[FaultHarness], None]:
    def play(loop: FaultHarness) -> None:
        loop.request(42.0)
        _changed(**parameters)(loop)

    return play


def _without_the_cold(node: str, usual: float) -> Callable[[FaultHarness], None]:
    """Return the play that takes the lower part of a node's range of the coolant for 15 min."""
    def play(loop: FaultHarness) -> None:
        loop.begin()
        loop.set_parameters(node, coolant_min=STUCK_AT)
        loop.run_for(900.0)
        loop.set_parameters(node, coolant_min=usual)
        loop.end()

    return play


def _constant(name: str, does: str, play: Callable[[FaultHarness], None], **details: Any) -> Case:
    return case(GROUP, name, does, play,
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
              _without_the_cold('plant', -20.0), worst=WINDUP),
    _constant('coolant-limited', f'the controller may not command less than {STUCK_AT:g} degC, '
              '15 min', _without_the_cold('controller', ControllerParameters.coolant_min),
              worst=WINDUP),
    _constant('noise', 'noise of 0.1 K, for good', _changed(noise=0.1), band=0.5, offset=0.5),
    _constant('two-state', 'the concentration moves, which the model does not know, and the feed '
              'gets 1 K warmer; near the stable point', _changed(feed_temperature=77.85),
              setpoint=50.5, plant={**LOCKSTEP, 'reactor': 'two_state'}),
)
