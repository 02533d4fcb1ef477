# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How each cost grows, of all parts that were measured, in one picture."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from benchmarks import site
from koopman_ros.reports import draw_limits, drawing

FILE = 'scale.png'
# What is held to, each at its own place.
_RECORD_SECONDS, _RECORD_MEGABYTES = 120.0, 500.0  # with a million samples
_STEP_US = (120.0, 60.0)  # in numpy, compiled
_WAYS = ('processes', 'hosted', 'domains')


def draw(path: Path, summary: Mapping[str, Any]) -> None:
    """Draw what grows, of the parts that are in a summary; no file where there are none."""
    drawn = [part for part, *_ in _PANELS if _drawable(part, summary)]
    found = [(title, panel) for part, title, panel in _PANELS if part in drawn]
    if not found:
        return
    columns = min(3, len(found))
    rows = -(-len(found) // columns)
    with drawing(path, rows, columns, size=(4.6 * columns, 4.3 * rows)) as (figure, panels):
        for axes, (title, panel) in zip(panels, found, strict=False):
            panel(axes, summary)
            axes.set_title(title, fontsize=10)
            # below, where no line is
            axes.legend(fontsize=7, loc='upper center', bbox_to_anchor=(0.5, -0.16), ncols=2,
                        frameon=False)
        for axes in panels[len(found):]:
            axes.set_axis_off()
        processor = summary[drawn[0]]['machine']['processor']
        figure.suptitle(f'How costs grow ({processor})', fontsize=11)


def _drawable(part: str, summary: Mapping[str, Any]) -> bool:
    """Tell whether a part was measured as far as it is drawn."""
    needed = {'training': ('seconds_per_iteration_by_samples', 'seconds_per_iteration_by_n_x'),
              'retraining': ('by_samples',), 'loop': ('step',), 'site': ('hosted',)}
    return all(key in summary.get(part, {}) for key in needed[part])


def _iterations(axes: Axes, summary: Mapping[str, Any]) -> None:
    found = summary['training']['seconds_per_iteration_by_samples']
    samples = [int(count) for count in found]
    axes.plot(samples, list(found.values()), 'o-', label='one iteration')
    last = list(found.values())[-1]
    axes.plot(samples, [last * count / samples[-1] for count in samples], color='0.5', ls=':',
              label='proportional to the samples')
    axes.set(xscale='log', yscale='log', xlabel='samples',
             ylabel='processor time of an iteration [s]')


def _sizes(axes: Axes, summary: Mapping[str, Any]) -> None:
    for name, marker, label in (('n_z', 'o', 'coordinates, of 1 state'),
                                ('n_x', 's', 'states, with 2 coordinates more')):
        found = summary['training'].get(f'seconds_per_iteration_by_{name}', {})
        axes.plot([int(count) for count in found], list(found.values()), f'{marker}-', label=label)
    axes.set(yscale='log', xlabel='coordinates or states',
             ylabel='processor time of an iteration [s]')
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _records(axes: Axes, summary: Mapping[str, Any]) -> None:
    for case, rows in summary['retraining']['by_samples'].items():
        axes.plot([one['samples'] for one in rows], [one['cpu_seconds'] for one in rows], 'o-',
                  label=case)
    draw_limits(axes, (_RECORD_SECONDS,), 'held to with 1e6 samples')
    axes.set(xscale='log', yscale='log', xlabel='samples of the record',
             ylabel='bag to lift, processor time [s]')


def _memory(axes: Axes, summary: Mapping[str, Any]) -> None:
    for case, rows in summary['retraining']['by_samples'].items():
        axes.plot([one['samples'] for one in rows], [one['peak_megabytes'] for one in rows],
                  'o-', label=case)
    draw_limits(axes, (_RECORD_MEGABYTES,), 'held to with 1e6 samples')
    axes.set(xscale='log', xlabel='samples of the record', ylabel='bag to lift, peak memory [MB]')
    axes.set_ylim(bottom=0.0)


def _steps(axes: Axes, summary: Mapping[str, Any]) -> None:
    found = summary['loop']['step']
    for column, label in (('naive_median_us', 'torch and python-control'),
                          ('median_us', 'numpy'), ('compiled_median_us', 'compiled')):
        by_size = {int(n_z): one[column] for n_z, one in found.items() if column in one}
        if by_size:
            axes.plot(list(by_size), list(by_size.values()), 'o-', label=label)
    draw_limits(axes, _STEP_US, 'held to: 120 in numpy, 60 compiled')
    axes.set(yscale='log', xlabel='coordinates', ylabel='control step, median [µs]')
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _loops(name: str) -> Callable[[Axes, Mapping[str, Any]], None]:
    def panel(axes: Axes, summary: Mapping[str, Any]) -> None:
        site.draw_growth(axes, name, {way: summary['site'].get(way, {}) for way in _WAYS})
        axes.set_xlabel('loops at 1 Hz')

    return panel


_PANELS: tuple[tuple[str, str, Callable[[Axes, Mapping[str, Any]], None]], ...] = (
    ('training', 'learning, by samples', _iterations),
    ('training', 'learning, by size', _sizes),
    ('retraining', 'retraining from a bag', _records),
    ('retraining', 'memory of a retraining', _memory),
    ('loop', 'control step', _steps),
    ('site', 'processor of a site', _loops('cores')),
    ('site', 'memory of a site', _loops('pss_megabytes')),
    ('site', 'latency of a site', _loops('p99_ms')),
    ('site', 'start of a site', _loops('discovery_seconds')),
)
