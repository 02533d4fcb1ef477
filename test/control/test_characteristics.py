# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop with a static characteristic commands what acts like the commands of one without."""

from dataclasses import replace

import numpy as np
import pytest

from koopman_ros.control import Controller, State
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.model import Coordinates, linearised_model, Provenance
from koopman_ros.tuning import Tuning

VALVE = Characteristic.of(np.linspace(0.0, 100.0, 11), np.linspace(0.0, 1.0, 11) ** 2)
OPEN = 50.0  # %


@pytest.mark.parametrize('law', ['sdre', 'linear', 'mpc'])
def test_commands_are_those_of_the_inverted_characteristic(law):
    def loop(**characteristics):
        inputs = Coordinates(('valve',), ('%',), *(np.array([value]) for value in (
            OPEN if characteristics else VALVE.effect(OPEN), 50.0, 0.0, 100.0)),
            characteristics=characteristics)
        states = Coordinates.spanning(('level',), ('m',), np.zeros(1), np.full(1, 2.0))
        model = linearised_model(np.array([[-0.1]]), np.array([[0.002]]), states, inputs, 's',
                                 Provenance('tank'))
        return Controller(model, replace(Tuning.for_model(model), fallback_order=(law,)))

    curved, straight = loop(valve=VALVE), loop()
    assert curved.model.inputs.half_widths == straight.model.inputs.half_widths
    states, x, applied = [State(), State()], 1.0, None
    for k in range(1, 30):
        commands = []
        for i, controller in enumerate((curved, straight)):
            states[i], command, report = controller.step(
                states[i], np.array([x]), k * NANOSECONDS, applied and applied[i])
            assert report.level == law
            commands.append(command)
        if k == 5:
            for i, controller in enumerate((curved, straight)):
                states[i], rejection = controller.request_setpoint(states[i], np.array([1.4]))
                assert rejection is None
        # published and limited as the input, acting as its effect
        assert VALVE.effect(commands[0]) == pytest.approx(commands[1], rel=1e-6, abs=1e-6)
        assert commands[0] != pytest.approx(commands[1], abs=1e-3) or k == 1
        applied = commands
        x += -0.1 * (x - 1.0) + 0.002 * float(commands[1][0] - VALVE.effect(OPEN))
    assert x == pytest.approx(1.4, abs=0.05)
