# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What may happen in a day: faults of the line, the operator, the weather; each ends by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import functools
import math

import numpy as np
from sensor_msgs.msg import Temperature

from validation.faults.alterations import (
    Alteration,
    delayed,
    frozen,
    lost,
    noise,
    twice,
    unchanged,
    value,
)
from validation.faults.rig import Rig


def _measure_badly(rig: Rig, random: np.random.Generator, make: Callable[[], Alteration]) -> None:
    rig.line.measurements = make()
    rig.run_for(float(random.uniform(2.0, 60.0)))
    rig.line.measurements = unchanged


def _command_badly(rig: Rig, random: np.random.Generator, make: Callable[[], Alteration]) -> None:
    rig.line.commands = make()
    rig.run_for(float(random.uniform(2.0, 60.0)))
    rig.line.commands = unchanged


def _ask(rig: Rig, random: np.random.Generator) -> None:
    rig.operator.ask(float(random.uniform(42.0, 50.0)))


def _ask_for_too_much(rig: Rig, random: np.random.Generator) -> None:
    celsius = float(random.choice([math.nan, 90.0, -1e9]))
    rig.operator.setpoint.publish(Temperature(temperature=celsius))


def _disturb(rig: Rig, random: np.random.Generator) -> None:
    rig.operator.set_parameters(
        'plant', feed_temperature=float(random.uniform(74.0, 80.0)),
        heat_transfer_coefficient=float(random.uniform(45000.0, 55000.0)),
        noise=float(random.uniform(0.0, 0.05)))


def _retune(rig: Rig, random: np.random.Generator) -> None:
    rig.operator.set_parameters(
        'controller', coolant_weight=float(10.0 ** random.uniform(-1.0, 1.0)),
        temperature_weight=float(random.choice([1.0, math.nan])))


def _by_hand(rig: Rig, random: np.random.Generator) -> None:
    rig.operator.set_bool('controller/set_automatic', False)
    rig.run_for(float(random.uniform(5.0, 60.0)))
    rig.operator.set_bool('controller/set_automatic', True)


def _other_model(rig: Rig, random: np.random.Generator) -> None:
    rig.operator.set_parameters('controller', model=str(random.choice(
        ['reactor_nz3', 'reactor_nz4', '/nowhere.safetensors'])))
    rig.operator.trigger('controller/reload_model')


def _reset(rig: Rig, _: np.random.Generator) -> None:
    rig.operator.trigger('plant/reset')


def _events() -> Iterator[tuple[str, Callable[[Rig, np.random.Generator], None]]]:
    makers: dict[str, Callable[[], Alteration]] = {
        'NaN': lambda: value(lambda *_: math.nan), '200 degC': lambda: value(lambda *_: 200.0),
        'spike': lambda: value(lambda _, shown: shown + 15.0), 'frozen': frozen,
        'noise of 1 K': lambda: noise(1.0), 'lost': lambda: lost(0.5),
        'late': lambda: delayed(3), 'doubled': lambda: twice}
    for name, make in makers.items():
        yield f'measurements: {name}', functools.partial(_measure_badly, make=make)
    for name in ('lost', 'late', 'doubled'):
        yield f'commands: {name}', functools.partial(_command_badly, make=makers[name])
    # what an operator does, and the weather, come more often
    for _ in range(4):
        yield 'set-point', _ask
        yield 'disturbance', _disturb
    yield 'impossible set-point', _ask_for_too_much
    yield 'weights', _retune
    yield 'manual mode', _by_hand
    yield 'model', _other_model
    yield 'plant reset', _reset


EVENTS: list[tuple[str, Callable[[Rig, np.random.Generator], None]]] = list(_events())
