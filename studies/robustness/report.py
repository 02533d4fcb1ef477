# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report of the robustness study, in Markdown, with its pictures."""

from collections.abc import Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from matplotlib.axes import Axes
import numpy as np

from koopman_ros.core.plots import drawing, DRAWN_RANGE, legend, Picture, table
from koopman_ros.core.status import level_words
from studies import report
from studies.robustness import disturbances, narrow, stability
from studies.robustness.loop import BANDWIDTH, shipped_model, START
from studies.robustness.stability import End, hottest_cooled, Margins
from studies.robustness.study import (
    BANDWIDTHS,
    COOLANT_WEIGHTS,
    Courses,
    margin_name,
    TEMPERATURES,
)

Figures: TypeAlias = Mapping[str, Any]  # of the study, by their names in its summary
_MARKS: dict[End, dict[str, Any]] = {
    End.LEARNED: {'marker': 'o', 'color': 'tab:green'},
    End.LINEAR: {'marker': 's', 'color': 'tab:blue'},
    End.SAFE: {'marker': 'D', 'color': 'tab:orange'},
    End.ELSEWHERE: {'marker': 'P', 'color': 'tab:purple'},
    End.RAN_AWAY: {'marker': 'x', 'color': 'tab:red'}}
_LEVELS = {'sdre': _MARKS[End.LEARNED], 'linear': _MARKS[End.LINEAR],
           'hold': _MARKS[End.ELSEWHERE], 'safe': _MARKS[End.SAFE]}
_PATHS: dict[str, dict[str, Any]] = {
    'narrow': {'color': 'tab:red', 'linestyle': '--', 'label': 'narrow lift, no fallback'},
    'guarded': {'color': 'tab:green', 'label': 'narrow lift, fallback'},
    'wide': {'color': '0.5', 'linestyle': ':', 'label': 'lift of wide data, fallback'}}


def write_report(figures: Figures, courses: Courses, folder: Path) -> None:
    """Write tables and pictures."""
    attraction = figures['attraction']
    ends = [[*attraction[name].values()]
            for name in ('fallback=True', 'fallback=False', 'two_state')]
    report.write(folder, 'How far the loop can be pushed', [
        '## Margins, smallest over the trained range', _margin_table(figures),
        '## Disturbances: deviation of the temperature; of steps, overshoot',
        _table(figures['disturbances']),
        '## A step by −10 K with a coolant whose dead time is wrong',
        _table(figures['wrong_dead_time']),
        '## Noise of 0.1 K at 1 Hz, and the time after UA −20 %',
        _table(figures['noise']),
        '## Region of attraction',
        'Under the coldest coolant the reactor heats up by itself above '
        f'{hottest_cooled():.2f} K. The hottest start that comes back:',
        _table(attraction['hottest_start']),
        table(('of all starts', 'with fallback', 'without', 'two-state reactor'), [
            (end.value, *(grid.count(end.value) for grid in ends)) for end in End]),
        'Back from the safe coolant:', _table(attraction['from_the_safe_coolant']),
        f'## Narrow data: within ±{narrow.HALF_WIDTH:g} K of the steady state',
        'The lift of narrow data alone (narrow) and with fallback (guarded), and the shipped one '
        '(wide):', _table(figures['narrow']['reactor']),
        'The shipped lift after UA −40 %:', _table(figures['narrow']['heat_transfer_-40%']),
        ], [*(draw(figures, folder / f'{name}.png') for name, draw in (
            ('margins', _draw_margins), ('noise', _draw_noise),
            ('attraction', _draw_attraction))), _draw_narrow(courses, folder / 'narrow.png')])


def _table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a table of figures, under their names."""
    return table(('', *map(_heading, next(iter(rows.values())))),
                 [(row, *map(_cell, figures.values())) for row, figures in rows.items()])


def _heading(name: str) -> str:
    """Return the name of a figure with its unit in brackets."""
    words, unit = name.split('_'), ''
    if 'to' in words:  # the time until a deviation is no larger
        words, unit = [word for word in words if word != 'seconds'], ' [s]'
    elif words[-1] == 'kelvin':
        words, unit = words[:-1], ' [K]'
    return ' '.join(words).replace('kelvin', 'K') + unit


def _cell(value: float | bool | None) -> str:
    if value is None or isinstance(value, bool):
        return {None: 'never', True: 'yes', False: 'no'}[value]
    return '0' if abs(value) < 5e-4 else f'{value:.5g}'


def _margins(figures: Figures, weight: float, bandwidth: float, name: str) -> list[float]:
    """Return a margin over the set-points."""
    return [figures['margins'][margin_name(weight, bandwidth, kelvin)][name]
            for kelvin in TEMPERATURES]


def _margin_table(figures: Figures) -> str:
    rows = [(f'{weight:g}', f'{bandwidth:g}', *(
        f'{min(_margins(figures, weight, bandwidth, name)):.{digits}f}' for name, digits in (
            ('gain', 0), ('phase_degrees', 0), ('delay_seconds', 1))))
        for weight, bandwidth in product(COOLANT_WEIGHTS, BANDWIDTHS)]
    return table(('coolant_weight', 'observer [1/min]', 'gain', 'phase [°]', 'delay [s]'), rows)


def _draw_margins(figures: Figures, path: Path) -> Picture:
    with drawing(path, 1, 3, size=(11.0, 3.8), sharex=True) as (_, axes):
        for axis, name, label in zip(axes, Margins._fields, ('gain margin', 'phase margin [°]',
                                                             'delay margin [s]'), strict=True):
            for number, bandwidth in enumerate(BANDWIDTHS):
                for weight, style in zip(COOLANT_WEIGHTS, ('-', '--'), strict=True):
                    axis.plot(TEMPERATURES, _margins(figures, weight, bandwidth, name), style,
                              color=f'C{number}',
                              label=f'{bandwidth:g} 1/min' if weight == 1.0 else None)
            axis.set(xlabel='set-point [K]', ylabel=label)
        for axis in (axes[0], axes[2]):
            axis.set_yscale('log')
        axes[1].legend(title='observer', fontsize=8)
        axes[0].set_title('solid: coolant_weight 1,  dashed: 0.1', fontsize=9)
    gain, delay = (min(_margins(figures, 1.0, BANDWIDTH, name))
                   for name in ('gain', 'delay_seconds'))
    return Picture(path.name, (
        'Margins of the true reactor under the sampled controller, opened at the coolant. With '
        f'the default parameters the gain may rise {gain:.0f}-fold, and {delay:.0f} s of dead '
        'time may be added, anywhere in the range.'))


def _draw_noise(figures: Figures, path: Path) -> Picture:
    found = {bandwidth: figures['noise'][f'bandwidth={bandwidth:g}']
             for bandwidth in disturbances.BANDWIDTHS}
    with drawing(path, 1, 2, size=(11.0, 3.8)) as (_, (left, right)):
        for name, label in (('coolant_kelvin', 'coolant'),
                            ('coolant_change_kelvin', 'coolant, change in a second'),
                            ('temperature_kelvin', 'true temperature')):
            left.plot([*found], [m[name] for m in found.values()], 'o-', label=label)
        left.axhline(disturbances.NOISE, color='0.5', linestyle=':', label='measurement')
        left.axvline(BANDWIDTH, color='0.7', linestyle='--')
        left.set(xlabel='observer_bandwidth [1/min]', ylabel='standard deviation [K]',
                 yscale='log')
        left.legend(fontsize=8)
        back = {f'{bandwidth:g}': m for bandwidth, m in found.items()
                if m['fouled_to_0.2_kelvin'] is not None}
        noise = [m['coolant_kelvin'] for m in back.values()]
        for tolerance in ('0.2', '0.001'):
            right.plot(noise, [m[f'fouled_to_{tolerance}_kelvin'] for m in back.values()], 'o-',
                       label=f'to {tolerance} K')
        for words, m in back.items():
            right.annotate(words, (m['coolant_kelvin'], m['fouled_to_0.2_kelvin']),
                           textcoords='offset points', xytext=(2, -12), fontsize=8)
        right.set(xlabel='standard deviation of the coolant [K]', ylabel='time after UA −20 % [s]',
                  xscale='log', title='numbers: observer_bandwidth [1/min]')
        right.legend(fontsize=8)
    usual = found[BANDWIDTH]
    return Picture(path.name, (
        f'Noise of 0.1 K at 1 Hz against speed. The default of {BANDWIDTH:g} 1/min moves the '
        f'coolant by {usual["coolant_kelvin"]:.2g} K and is within 0.2 K '
        f'{usual["fouled_to_0.2_kelvin"]:.0f} s after the jacket lost a fifth of UA.'))


def _scatter(axis: Axes, ends: Iterable[tuple[float, float, str]]) -> None:
    """Mark how the loop ends from some starts, over the trained range."""
    points = list(ends)
    for end, mark in _MARKS.items():
        chosen = [(x, y) for x, y, found in points if found == end.value]
        if chosen:
            x, y = np.array(chosen).T
            axis.scatter(x, y, s=18, label=end.value, **mark)
    states = shipped_model().states
    axis.axhspan(states.lower[0], states.upper[0], **DRAWN_RANGE)


def _draw_attraction(figures: Figures, path: Path) -> Picture:
    attraction = figures['attraction']
    hottest = {coolant: attraction['hottest_start'][f'coolant={coolant:g}K']
               for coolant in stability.COOLANTS}
    with drawing(path, 1, 4, size=(11.0, 4.6)) as (figure, axes):
        for axis, fallback in zip(axes, (True, False), strict=False):
            ends = attraction[f'fallback={fallback}']
            _scatter(axis, ((goal, start, ends[f'{start:g}K to {goal:g}K'])
                            for goal, start in product(stability.SETPOINTS, stability.STARTS)))
            axis.set(title=f'{"with" if fallback else "without"} fallback', xlabel='set-point [K]',
                     ylabel='temperature at the start [K]')
        for name, label, style in (
                ('physics_kelvin', 'no coolant saves it above', 'k-'),
                ('fallback_kelvin', 'the loop with fallback', 'o--'),
                ('no_fallback_kelvin', 'the learned law alone', 'x:')):
            axes[2].plot([*hottest], [m[name] for m in hottest.values()], style, label=label)
        axes[2].set(title='hottest start that comes back', xlabel='coolant at the start [K]',
                    ylabel='[K]')
        axes[2].legend(fontsize=7)
        _scatter(axes[3], ((c, kelvin, attraction['two_state'][f'{kelvin:g}K, {c:.3g}mol/L'])
                           for kelvin, c in stability.two_state_starts()))
        axes[3].set(title='two-state reactor', xlabel='C$_A$ at the start [mol/L]')
        legend(figure, (axes[0], axes[1], axes[3]), 5)
    return Picture(path.name, (
        'Where the loop comes back from (grey: the trained range). Above '
        f'{hottest_cooled():.1f} K no coolant within its limits cools the reactor; '
        'with the coolant at 300 K, which falls by 1 K a second at most, none saves it from above '
        f'{hottest[300.0]["physics_kelvin"]:.1f} K.'))


def _draw_narrow(courses: Courses, path: Path) -> Picture:
    with drawing(path, 1, 3, size=(11.0, 4.6), sharey=True) as (figure, axes):
        for axis, trial in zip(axes, narrow.TRIALS, strict=True):
            for kind, style in _PATHS.items():
                course = courses[trial.name, kind]
                minutes, kelvin = course.times / 60.0, course.states[:, 0]
                axis.plot(minutes, kelvin, **style)
                # where another level takes over
                for number, level in enumerate(course.levels if kind == 'guarded' else ()):
                    if number == 0 or level != course.levels[number - 1]:
                        axis.plot(minutes[number], kelvin[number], markersize=6,
                                  linestyle='none', markeredgecolor='k', **_LEVELS[level])
            axis.axhspan(START - narrow.HALF_WIDTH, START + narrow.HALF_WIDTH, **DRAWN_RANGE)
            axis.set(xlabel='time [min]', ylim=(295.0, 350.0))
            axis.set_title(trial.name, fontsize=9)
        axes[0].set_ylabel('temperature [K]')
        for level, mark in _LEVELS.items():
            axes[0].plot([], [], linestyle='none', markeredgecolor='k',
                         label=f'takes {level_words(level)}', **mark)
        legend(figure, axes[:1], 4)
    return Picture(path.name, (
        'A lift of narrow data (grey: the data) used outside them. The fallback keeps the loop '
        'from running away, and leads it back from the cold.'))
