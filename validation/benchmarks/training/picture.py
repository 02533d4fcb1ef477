# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The picture: rw over time for all solvers, and the cost of an iteration over the samples."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
import numpy as np

from koopman_ros.reports import drawing, legend
from validation.benchmarks.training.plan import DRAWN, SOLVERS, SYSTEMS, TARGETS

_COLOURS = {'ours': '#0b6e4f', 'ipopt': '#c8553d', 'ipopt_compiled': '#e8a33d',
            'lbfgs': '#3d5a98', 'adam': '#8d7aae'}
_FIRST = 1e-3  # s, the left end of the time axis

Trace = list[tuple[float, float]]


def draw(path: Path, traces: dict[tuple[str, int, int], dict[str, Trace]],
         figures: dict[str, Any]) -> None:
    """Draw what there is; a panel whose figures are missing is left out."""
    with drawing(path, 1, 3, size=(14.0, 5.0),
                 width_ratios=(1.0, 1.0, 0.8)) as (figure, axes):
        for ax, system in zip(axes, SYSTEMS, strict=False):
            sizes = [key[1:] for key in traces if key[0] == system]
            if not sizes:
                ax.set_axis_off()
                continue
            size = DRAWN if DRAWN in sizes else sizes[-1]
            case = next(case for case in figures['cases'] if case['system'] == system
                        and (case['samples'], case['hidden']) == size)
            _draw_traces(ax, traces[system, *size], case)
        _draw_cost(axes[2], figures)
        for solver, label in SOLVERS.items():
            axes[0].plot([], [], color=_COLOURS[solver], lw=_width(solver), label=label)
        legend(figure, axes[:1], len(SOLVERS))
        machine = figures['machine']
        figure.suptitle(
            f'Training: accuracy over time from the same start ({machine["processor"]}, one '
            f'thread, torch {machine["torch"]}, casadi {machine["casadi"]})', fontsize=11)


def _width(solver: str) -> float:
    return 2.6 if solver == 'ours' else 1.6


def _draw_traces(ax: Axes, traces: dict[str, Trace], case: dict[str, Any]) -> None:
    last = _FIRST
    for solver in SOLVERS:
        trace = traces[solver]
        if not trace:
            continue
        seconds, rw = (np.array(part) for part in zip(*trace, strict=True))
        rw = np.minimum.accumulate(rw)
        ax.plot(np.maximum(seconds, _FIRST), rw, color=_COLOURS[solver], lw=_width(solver),
                drawstyle='steps-post')
        last = max(last, seconds[-1])
        if build := case.get(f'{solver}_build_seconds'):
            ax.annotate(f'+{build:.0f} s to build', (seconds[-1], rw[-1]), xytext=(5, -3),
                        textcoords='offset points', fontsize=8, color=_COLOURS[solver])
    for name, target in TARGETS.items():
        if name not in case['not_asked']:
            ax.axhline(target, color='0.5', lw=0.9, ls=':', zorder=1)
    ax.set(xscale='log', yscale='log', xlim=(_FIRST, 25.0 * last), xlabel='time of one thread [s]',
           ylabel='relative residual rw on the training samples')
    ax.set_title(f'{case["system"]}: N = {case["samples"]}, n$_z$ = 3, {case["hidden"]} hidden '
                 'units', fontsize=10)


def _draw_cost(ax: Axes, figures: dict[str, Any]) -> None:
    by_samples = figures.get('seconds_per_iteration_by_samples', {})
    if not by_samples:
        ax.set_axis_off()
        return
    samples = np.array([int(key) for key in by_samples])
    seconds = np.array(list(by_samples.values()))
    ax.plot(samples, seconds, 'o-', color=_COLOURS['ours'], lw=2.0,
            label='ours, with its peak memory beyond the data')
    ax.plot(samples, seconds[-1] * samples / samples[-1], color='0.5', lw=1.0, ls='--',
            label='proportional to N')
    for n, s in zip(samples, seconds, strict=True):
        peak = figures['peak_memory_by_samples'].get(str(n))
        if peak is not None:
            ax.annotate(f'{peak:.0f} MB', (n, s), xytext=(-8, 6), fontsize=8, ha='right',
                        textcoords='offset points', color='0.3')
    ax.legend(fontsize=8, loc='lower right')
    ax.set(xscale='log', yscale='log', xlim=(samples[0] / 8, samples[-1] * 3),
           ylim=(seconds[-1] * samples[0] / samples[-1] / 5, 3 * seconds[-1]),
           xlabel='samples N', ylabel='time of an iteration [s]')
    ax.set_title('a step of ours: n$_x$ = 2, n$_z$ = 3, 16 units', fontsize=10)
