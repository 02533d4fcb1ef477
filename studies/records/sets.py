# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The records: public ones from a folder, and two simulated ones."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from koopman_ros.core.arrays import Array
from koopman_ros.core.integration import runge_kutta_step

#: records to learn from, and the one to test on; columns are the time and the signals, with units
Frames: TypeAlias = tuple[list[pd.DataFrame], pd.DataFrame]


@dataclass(frozen=True)
class RecordSet:
    """A plant with records to learn from and a record to test on."""

    states: tuple[str, ...]  #: measured, with units
    inputs: tuple[str, ...]  #: with units
    frames: Callable[[Path], Frames]  #: reads the files in a folder
    files: tuple[str, ...] = ()  #: their names; none for a simulated plant
    init: int = 50  #: samples that determine the start of a free run
    #: whether other methods get the outputs above the first sample of each record
    above_first: bool = False
    published: str = ''  #: errors in the literature


def _columns(frame: pd.DataFrame, period: float, unit: str = 's', **columns: str) -> pd.DataFrame:
    """Return columns by new names, as `level__V`, with a time."""
    return pd.DataFrame({f'time [{unit}]': period * np.arange(len(frame)), **{
        '{} [{}]'.format(*name.split('__')): frame[column].to_numpy()
        for name, column in columns.items()}})


def _tanks(folder: Path) -> Frames:
    frame = pd.read_csv(folder / 'cascaded_tanks.csv')
    learn, test = (_columns(frame, 4.0, pump__V=f'u{part}', level__V=f'y{part}')
                   for part in ('Est', 'Val'))
    return [learn], test


def _hair_dryer(folder: Path) -> Frames:
    frame = pd.read_csv(folder / 'hairdryer.csv')
    learn, test = (_columns(part, 0.08, heater__V='heater [V]', temperature__V='temperature [V]')
                   for part in (frame[:500], frame[500:]))
    return [learn], test


def _tclab(folder: Path) -> Frames:
    energy, mimo, hybrid = (pd.read_csv(folder / f'tclab_{name}.csv')
                            for name in ('energy', 'mimo', 'hybrid'))
    return [energy, mimo], hybrid


def _duffing(_: Path) -> Frames:
    """Return a Duffing oscillator whose input is linear from sample to sample; 1 mV of noise."""
    period, parts = 1.0 / 610.35, 8

    def rate(x: Array, v: float) -> Array:
        return np.array([x[1], -40.0 * x[1] - 1.9e5 * x[0] - 3.5e6 * x[0] ** 3 + 1.9e5 * v])

    def run(count: int, seed: int, noise: float) -> pd.DataFrame:
        rng = np.random.default_rng(seed)
        u = np.convolve(rng.normal(0.0, 0.045, count + 4), np.full(4, 0.5), 'same')[:count]
        x, y = np.zeros(2), np.empty(count)
        for k in range(count):
            y[k] = x[0]
            slope = u[min(k + 1, count - 1)] - u[k]
            for part in range(parts):
                x = runge_kutta_step(partial(rate, v=u[k] + slope * (part + 0.5) / parts), x,
                                     period / parts)
        return pd.DataFrame({'time [s]': period * np.arange(count), 'force [V]': u,
                             'position [V]': y + noise * rng.standard_normal(count)})

    return [run(3000, 1, 1e-3)], run(2000, 9, 0.0)


def _cooled_reactor(_: Path) -> Frames:
    """Return the CSTR of Morningred et al. (1990), coolant stepped each minute, without noise."""
    parts, count, learned = 5, 3000, 2000
    rng = np.random.default_rng(0)
    coolant = np.repeat(rng.uniform(90.0, 111.0, count // 10), 10)

    def rate(x: Array, q: float) -> Array:
        reaction = 7.2e10 * np.exp(-1e4 / x[1]) * x[0]
        return np.array([1.0 - x[0] - reaction, 350.0 - x[1] + 200.0 * reaction
                         + 0.01 * q * (1.0 - np.exp(-700.0 / q)) * (350.0 - x[1])])

    x, states = np.array([0.09, 441.0]), np.empty((count, 2))
    for k, q in enumerate(coolant):
        states[k] = x
        for _part in range(parts):
            x = runge_kutta_step(partial(rate, q=q), x, 0.1 / parts)
    frame = pd.DataFrame({
        'time [min]': 0.1 * np.arange(count), 'coolant [L/min]': coolant,
        'concentration [mol/L]': states[:, 0], 'temperature [K]': states[:, 1]})
    return [frame[:learned]], frame[learned:]


SETS = {
    'cascaded_tanks': RecordSet(
        ('level [V]',), ('pump [V]',), _tanks, ('cascaded_tanks.csv',),
        published='0.34 V by a nonlinear state space (Relan et al., 2017), 0.18 V by a grey box'),
    'hair_dryer': RecordSet(
        ('temperature [V]',), ('heater [V]',), _hair_dryer, ('hairdryer.csv',)),
    'tclab': RecordSet(
        ('temperature_1 [degC]', 'temperature_2 [degC]'),
        ('heater_1 [percent]', 'heater_2 [percent]'), _tclab,
        ('tclab_energy.csv', 'tclab_mimo.csv', 'tclab_hybrid.csv'), above_first=True),
    'duffing': RecordSet(('position [V]',), ('force [V]',), _duffing),
    'cooled_reactor': RecordSet(
        ('concentration [mol/L]', 'temperature [K]'), ('coolant [L/min]',), _cooled_reactor)}
