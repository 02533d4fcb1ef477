# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What may happen in a day: faults of messages, requests, disturbances; each ends by itself."""

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
    value,
)
from validation.faults.harness import FaultHarness


def _alter(loop: FaultHarness, random: np.random.Generator, what: str,
           make: Callable[[], Alteration]) -> None:
    loop.alter(float(random.uniform(2.0, 60.0)), **{what: make()})


def _ask(loop: FaultHarness, random: np.random.Generator) -> None:
    loop.request(float(random.uniform(42.0, 50.0)))


def _ask_for_too_much(loop: FaultHarness, random: np.random.Generator) -> None:
    celsius = float(random.choice([math.nan, 90.0, -1e9]))
    loop.setpoint.publish(Temperature(temperature=celsius))


def _disturb(loop: FaultHarness, random: np.random.Generator) -> None:
    loop.set_parameters(
        'plant', feed_temperature=float(random.uniform(74.0, 80.0)),
        heat_transfer_coefficient=float(random.uniform(45000.0, 55000.0)),
        noise=float(random.uniform(0.0, 0.05)))


def _retune(loop: FaultHarness, random: np.random.Generator) -> None:
    loop.set_parameters(
        'controller', coolant_weight=float(10.0 ** random.uniform(-1.0, 1.0)),
        temperature_weight=float(random.choice([1.0, math.nan])))


def _by_hand(loop: FaultHarness, random: np.random.Generator) -> None:
    loop.ros.set_bool('controller/set_automatic', False)
    loop.run_for(float(random.uniform(5.0, 60.0)))
    loop.ros.set_bool('controller/set_automatic', True)


def _other_model(loop: FaultHarness, random: np.random.Generator) -> None:
    loop.set_parameters('controller', model=str(random.choice(
        ['reactor_nz3', 'reactor_nz4', '/nowhere.safetensors'])))
    loop.ros.trigger('controller/reload_model')


def _reset(loop: FaultHarness, _: np.random.Generator) -> None:
    loop.ros.trigger('plant/reset')


def _events() -> Iterator[tuple[str, Callable[[FaultHarness, np.random.Generator], None]]]:
    makers: dict[str, Callable[[], Alteration]] = {
        'NaN': lambda: value(lambda *_: math.nan), '200 degC': lambda: value(lambda *_: 200.0),
        'spike': lambda: value(lambda _, shown: shown + 15.0), 'frozen': frozen,
        'noise of 1 K': lambda: noise(1.0), 'lost': lambda: lost(0.5),
        'late': lambda: delayed(3), 'doubled': lambda: twice}
    for what, names in (('measurements', [*makers]), ('commands', ['lost', 'late', 'doubled'])):
        for name in names:
            yield f'{what}: {name}', functools.partial(_alter, what=what, make=makers[name])
    # what an operator does, and the weather, come more often
    for _ in range(4):
        yield 'set-point', _ask
        yield 'disturbance', _disturb
    yield 'impossible set-point', _ask_for_too_much
    yield 'weights', _retune
    yield 'manual mode', _by_hand
    yield 'model', _other_model
    yield 'plant reset', _reset


EVENTS: list[tuple[str, Callable[[FaultHarness, np.random.Generator], None]]] = list(_events())
