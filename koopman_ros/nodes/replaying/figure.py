# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay's picture: what was measured, what was commanded, and where commands differ."""

from __future__ import annotations

from pathlib import Path
import textwrap

import numpy as np

from koopman_ros.nodes.messages import to_celsius
from koopman_ros.nodes.parameters import ConfigurationError
from koopman_ros.nodes.replay_parameters import ReplayParameters
from koopman_ros.nodes.replaying.comparison import ReplayedBag
from koopman_ros.nodes.replaying.report import verdict

try:
    import matplotlib
except ImportError as error:
    raise ConfigurationError(
        "the picture needs matplotlib, which is missing: pip install 'koopman_ros[demo]', or "
        'apt-get install python3-matplotlib') from error

matplotlib.use('Agg')
from matplotlib import pyplot
from matplotlib.axes import Axes

_RECORDED, _CHECK, _NEW = '0.55', 'tab:blue', 'tab:orange'


def draw(path: Path, bag: ReplayedBag, parameters: ReplayParameters) -> None:
    """
    Draw a replayed bag.

    :param path: PNG file to write.
    :param bag: what to draw.
    :param parameters: with the limits and the names of the models.
    """
    figure, axes = pyplot.subplots(3, 1, sharex=True, figsize=(9.0, 9.0), layout='constrained',
                                   height_ratios=(1.0, 1.2, 0.8))
    time, label = _time(bag)
    _draw_temperature(axes[0], time, bag)
    _draw_commands(axes[1], time, bag, parameters)
    _draw_difference(axes[2], time, bag, parameters)
    axes[0].set_title('\n'.join([f'{Path(bag.path).name}: recorded and replayed commands',
                                 *textwrap.wrap(verdict(bag), 90)]), fontsize='medium')
    axes[2].set_xlabel(label)
    if len(time) > 1:
        axes[2].set_xlim(time[0], time[-1])
    for one in axes:
        one.grid(alpha=0.3)
        one.legend(loc='best', fontsize='small', framealpha=0.9)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def _time(bag: ReplayedBag) -> tuple[np.ndarray, str]:
    """Return the axis: stamps, or the number of the measurement when stamps go back."""
    seconds = bag.seconds
    if np.any(np.diff(seconds) < 0.0):
        return np.arange(1.0, len(seconds) + 1.0), 'measurement (the stamps go back in this bag)'
    if seconds[-1] > 300.0:
        return seconds / 60.0, 'time since the first measurement [min]'
    return seconds, 'time since the first measurement [s]'


def _draw_temperature(axes: Axes, time: np.ndarray, bag: ReplayedBag) -> None:
    low, high = (to_celsius(float(bound[0])) for bound in (bag.trained.lower, bag.trained.upper))
    shown = _typical(bag.temperature)
    hidden = len(bag.temperature) - len(shown)
    axes.axhspan(low, high, color='0.93', label='range of training', zorder=0)
    axes.step(time, bag.setpoint, 'k--', where='post', linewidth=1.2, label='set-point tracked')
    axes.plot(time, bag.temperature, color='tab:green', label='temperature measured' + (
        f' ({hidden} of {len(bag.temperature)} outside the picture)' if hidden else ''))
    both = np.concatenate([shown, bag.setpoint[np.isfinite(bag.setpoint)]])
    if both.size:
        margin = 0.5 + 0.05 * float(np.ptp(both))
        axes.set_ylim(float(both.min()) - margin, float(both.max()) + margin)
    axes.set_ylabel('reactor temperature [°C]')


def _typical(values: np.ndarray) -> np.ndarray:
    """Return what a picture should show: a broken sensor's values would flatten all others."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return finite
    low, high = np.percentile(finite, (2.0, 98.0))
    reach = high - low + 1.0
    return finite[(finite >= low - reach) & (finite <= high + reach)]


def _draw_commands(axes: Axes, time: np.ndarray, bag: ReplayedBag, parameters: ReplayParameters
                   ) -> None:
    axes.axhline(parameters.coolant_max, color='0.3', linestyle=':', label='coolant limits')
    axes.axhline(parameters.coolant_min, color='0.3', linestyle=':')
    axes.step(time, bag.recorded, where='post', color=_RECORDED, linewidth=4.0, label='recorded')
    axes.step(time, bag.commands, where='post', color=_CHECK, linewidth=1.2,
              label=f'replayed with {_short(parameters.model)}')
    if bag.new_commands is not None:
        axes.step(time, bag.new_commands, where='post', color=_NEW, linewidth=1.5,
                  label=f'{_short(parameters.new_model)} on the same measurements')
    axes.set_ylabel('coolant set-point [°C]')


def _draw_difference(axes: Axes, time: np.ndarray, bag: ReplayedBag, parameters: ReplayParameters
                     ) -> None:
    axes.axhspan(-parameters.tolerance, parameters.tolerance, color='0.9',
                 label=f'within ±{parameters.tolerance:g} K', zorder=0)
    drawn = [(bag.check, _CHECK, f'replayed with {_short(parameters.model)}')]
    if bag.new is not None:
        drawn.append((bag.new, _NEW, _short(parameters.new_model)))
    for comparison, color, name in drawn:
        axes.step(time, comparison.difference, where='post', color=color, linewidth=1.2,
                  label=f'{name}: {np.count_nonzero(comparison.beyond)} of '
                        f'{comparison.compared} beyond')
        spots = comparison.beyond
        axes.plot(time[spots], comparison.difference[spots], '.', color='tab:red', markersize=4.0)
    axes.set_ylabel('command minus recorded [K]')


def _short(name: str) -> str:
    return Path(name).name.removesuffix('.safetensors')
