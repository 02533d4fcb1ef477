# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of the robustness study."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np
from numpy.typing import NDArray

from koopman_ros.control import Simulation
from koopman_ros.reasons import level_words
from koopman_ros.reports import drawing, DRAWN_RANGE, legend, Picture
from validation.paper import two_state
from validation.robustness import attraction, disturbances, narrow
from validation.robustness.attraction import End
from validation.robustness.loop import BANDWIDTH, START
from validation.robustness.study import (
    BANDWIDTHS,
    COOLANT_WEIGHTS,
    Found,
    TEMPERATURES,
    trained_range,
)

_MARKS: dict[End, dict[str, Any]] = {
    End.LEARNED: {'marker': 'o', 'color': 'tab:green'},
    End.LINEAR: {'marker': 's', 'color': 'tab:blue'},
    End.SAFE: {'marker': 'D', 'color': 'tab:orange'},
    End.ELSEWHERE: {'marker': 'P', 'color': 'tab:purple'},
    End.RAN_AWAY: {'marker': 'x', 'color': 'tab:red'}}
_LEVELS: dict[str, dict[str, Any]] = {
    'sdre': {'marker': 'o', 'color': 'tab:green'},
    'linear': {'marker': 's', 'color': 'tab:blue'},
    'hold': {'marker': 'P', 'color': 'tab:purple'},
    'safe': {'marker': 'D', 'color': 'tab:orange'}}

_PATHS: dict[str, dict[str, Any]] = {
    'narrow': {'color': 'tab:red', 'linestyle': '--', 'label': 'narrow lift, no fallback'},
    'guarded': {'color': 'tab:green', 'label': 'narrow lift, fallback'},
    'wide': {'color': '0.5', 'linestyle': ':', 'label': 'lift of wide data, fallback'}}


def draw(found: Found, folder: Path) -> list[Picture]:
    """Draw all figures into a folder."""
    return [_margins(found, folder / 'margins.png'), _noise(found, folder / 'noise.png'),
            _attraction(found, folder / 'attraction.png'), _narrow(found, folder / 'narrow.png')]


def _margins(found: Found, path: Path) -> Picture:
    with drawing(path, 1, 3, size=(11.0, 3.8), sharex=True) as (_, axes):
        for axis, name, unit in zip(axes, ('gain', 'phase', 'delay'), ('', ' [°]', ' [s]'),
                                    strict=True):
            for number, bandwidth in enumerate(BANDWIDTHS):
                for weight, style in zip(COOLANT_WEIGHTS, ('-', '--'), strict=True):
                    values = [getattr(found.margins[weight, bandwidth, float(kelvin)], name)
                              for kelvin in TEMPERATURES]
                    axis.plot(TEMPERATURES, values, style, color=f'C{number}',
                              label=f'{bandwidth:g} 1/min' if weight == 1.0 else None)
            axis.set(xlabel='set-point [K]', ylabel=f'{name} margin{unit}')
        for axis in (axes[0], axes[2]):
            axis.set_yscale('log')
        axes[1].legend(title='observer', fontsize=8)
        axes[0].set_title('solid: coolant_weight 1,  dashed: 0.1', fontsize=9)
    usual = [found.margins[1.0, BANDWIDTH, float(kelvin)] for kelvin in TEMPERATURES]
    return Picture(path.name, (
        'Margins of the true reactor under the sampled controller, opened at the coolant. With '
        f'the default parameters the gain may rise {min(m.gain for m in usual):.0f}-fold, and '
        f'{min(m.delay for m in usual):.0f} s of dead time may be added, anywhere in the range.'))


def _column(rows: Mapping[float, Mapping[str, Any]], keys: Iterable[float], name: str
            ) -> NDArray[np.float64]:
    """Return a figure of each row; NaN where there is none."""
    return np.array([rows[key][name] for key in keys], dtype=np.float64)


def _noise(found: Found, path: Path) -> Picture:
    with drawing(path, 1, 2, size=(11.0, 3.8)) as (_, (left, right)):
        bandwidths = list(found.noise)
        for name, label in (('coolant_kelvin', 'coolant'),
                            ('coolant_change_kelvin', 'coolant, change in a second'),
                            ('temperature_kelvin', 'true temperature')):
            left.plot(bandwidths, _column(found.noise, bandwidths, name), 'o-', label=label)
        left.axhline(disturbances.NOISE, color='0.5', linestyle=':', label='measurement')
        left.axvline(BANDWIDTH, color='0.7', linestyle='--')
        left.set(xlabel='observer_bandwidth [1/min]', ylabel='standard deviation [K]',
                 yscale='log')
        left.legend(fontsize=8)
        speeds = [b for b in bandwidths if found.noise[b]['fouled_to_0.2_kelvin'] is not None]
        for name, label in (('fouled_to_0.2_kelvin', 'to 0.2 K'), ('fouled_to_0.001_kelvin',
                                                                   'to 0.001 K')):
            right.plot(_column(found.noise, speeds, 'coolant_kelvin'),
                       _column(found.noise, speeds, name), 'o-', label=label)
        for b in speeds:
            right.annotate(f'{b:g}', (found.noise[b]['coolant_kelvin'],
                                      found.noise[b]['fouled_to_0.2_kelvin']),
                           textcoords='offset points', xytext=(2, -12), fontsize=8)
        right.set(xlabel='standard deviation of the coolant [K]', ylabel='time after UA −20 % [s]',
                  xscale='log', title='numbers: observer_bandwidth [1/min]')
        right.legend(fontsize=8)
    usual = found.noise[BANDWIDTH]
    return Picture(path.name, (
        f'Noise of 0.1 K at 1 Hz against speed. The default of {BANDWIDTH:g} 1/min moves the '
        f'coolant by {usual["coolant_kelvin"]:.2g} K and is within 0.2 K '
        f'{usual["fouled_to_0.2_kelvin"]:.0f} s after the jacket lost a fifth of UA.'))


def _scatter(axis: Axes, ends: Iterable[tuple[float, float, End]]) -> None:
    points = list(ends)
    for end, mark in _MARKS.items():
        chosen = [(x, y) for x, y, found in points if found is end]
        if chosen:
            x, y = np.array(chosen).T
            axis.scatter(x, y, s=18, label=end.value, **mark)


def _attraction(found: Found, path: Path) -> Picture:
    with drawing(path, 1, 4, size=(11.0, 4.6)) as (figure, axes):
        for axis, fallback in zip(axes, (True, False), strict=False):
            _scatter(axis, ((goal, start, end)
                            for (start, goal), end in found.grids[fallback].items()))
            axis.axhspan(*trained_range(), **DRAWN_RANGE)
            axis.set(title=f'{"with" if fallback else "without"} fallback', xlabel='set-point [K]',
                     ylabel='temperature at the start [K]')
        coolants = list(found.boundaries)
        for name, label, style in (
                ('physics_kelvin', 'no coolant saves it above', 'k-'),
                ('ladder_kelvin', 'the loop with fallback', 'o--'),
                ('no_ladder_kelvin', 'the learned law alone', 'x:')):
            axes[2].plot(coolants, _column(found.boundaries, coolants, name), style, label=label)
        axes[2].set(title='hottest start that comes back', xlabel='coolant at the start [K]',
                    ylabel='[K]')
        axes[2].legend(fontsize=7)
        _scatter(axes[3], ((c, kelvin, end) for (kelvin, c), end in found.two_state_grid.items()))
        axes[3].axhspan(*trained_range(), **DRAWN_RANGE)
        axes[3].set(title='two-state reactor', xlabel='C$_A$ at the start [mol/L]')
        legend(figure, (axes[0], axes[1], axes[3]), 5)
    return Picture(path.name, (
        'Where the loop comes back from (grey: the trained range). Above '
        f'{attraction.hottest_cooled():.1f} K no coolant within its limits cools the reactor; '
        'with the coolant at 300 K, which falls by 1 K a second at most, none saves it from above '
        f'{found.boundaries[300.0]["physics_kelvin"]:.1f} K.'))


def _mark(axis: Axes, course: Simulation, x: np.ndarray, y: np.ndarray) -> None:
    """Mark where another level takes over."""
    for number, level in enumerate(course.levels):
        if number == 0 or level != course.levels[number - 1]:
            axis.plot(x[number], y[number], markersize=6, linestyle='none', markeredgecolor='k',
                      **_LEVELS[level])


def _narrow(found: Found, path: Path) -> Picture:
    with drawing(path, 1, 4, size=(11.0, 4.6)) as (figure, axes):
        for axis, trial in zip(axes, narrow.TRIALS, strict=False):
            for kind, style in _PATHS.items():
                course = found.reactor[trial.name, kind]
                minutes = course.times / 60.0
                axis.plot(minutes, course.states[:, 0], **style)
                if kind == 'guarded':
                    _mark(axis, course, minutes, course.states[:, 0])
            axis.axhspan(START - narrow.HALF_WIDTH, START + narrow.HALF_WIDTH, **DRAWN_RANGE)
            axis.set(title=trial.name, xlabel='time [min]', ylim=(295.0, 350.0))
            axis.title.set_fontsize(9)
        axes[0].set_ylabel('temperature [K]')
        for kind, style in _PATHS.items():
            key = ('wide', 'guarded') if kind == 'wide' else (narrow.NARROWEST, kind)
            course = found.two_state[key]
            axes[3].plot(course.states[:, 0], course.states[:, 1], **{**style, 'label': None})
            if kind == 'guarded':
                _mark(axes[3], course, course.states[:, 0], course.states[:, 1])
        course = found.two_state['true linearisation', 'narrow']
        axes[3].plot(course.states[:, 0], course.states[:, 1], color='k', linewidth=0.8,
                     label='true linearisation')
        axes[3].legend(fontsize=8, loc='lower right')
        box = two_state.NARROW[narrow.NARROWEST]
        axes[3].fill_between((box.lower[0], box.upper[0]), box.lower[1], box.upper[1],
                             **DRAWN_RANGE)
        axes[3].set(title=f'two-state example, {narrow.NARROWEST}', xlabel='x$_1$', ylabel='x$_2$',
                    ylim=(-40.0, 40.0))
        axes[3].title.set_fontsize(9)
        for level, mark in _LEVELS.items():
            axes[0].plot([], [], linestyle='none', markeredgecolor='k',
                         label=f'takes {level_words(level)}', **mark)
        legend(figure, axes[:1], 4)
    return Picture(path.name, (
        'Lifts of narrow data (grey: the data) asked for more than they know. On the reactor the '
        'fallback keeps the loop from running away, and leads it back from the cold; the '
        'two-state example is unstable by itself and no constant input saves it.'))
