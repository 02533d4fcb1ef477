# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Many loops at 1 Hz, hosted by one process or in a process each: memory, processor, latency."""

from collections.abc import Iterator
import contextlib
from dataclasses import dataclass
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from koopman_ros.reports import draw_limits, drawing, legend, table
from koopman_ros.testing import isolated_domain, NodeProcess

PACKAGES = ('numpy', 'scipy', 'ros-jazzy-rclpy', 'ros-jazzy-rmw-fastrtps-cpp')
MEANING = {
    'hosted': 'by number of loops: all in one process, as `controller --loops` runs them',
    'processes': 'by number of loops: a controller process for each',
    'answering': 'loops that had answered when the patience for it was over',
    'discovery_seconds': 'from the start of the first process until every loop had answered',
    'start_cpu_seconds': 'processor time of all their processes until then',
    'cores': 'processor time of all their processes in a second; median of the windows',
    'p99_ms': '99th percentile from stamp to command, as the sensor sees it; median of the '
              'windows',
    'pss_megabytes': 'memory, with what processes share counted once',
    'gives_way': 'what is not kept first as loops are added, of what is held to',
}
HELD_TO = {'pss_megabytes': 400.0, 'cores': 0.5, 'p99_ms': 50.0}  # with 100 hosted loops
_SIGNAL = {'pss_megabytes': 'memory (PSS) [MB]', 'cores': 'processor [cores]',
           'p99_ms': 'stamp to command, p99 [ms]', 'discovery_seconds': 'until all answer [s]'}
_STYLES = {'hosted': ('tab:blue', 'o', 'hosted by one process'),
           'processes': ('tab:orange', 's', 'a process each')}
_PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_SETTLE = 3.0  # s
_END = 60.0  # s; the middleware takes leave of each node


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    hosted: tuple[int, ...]  #: numbers of loops in one process
    processes: tuple[int, ...]  #: numbers of loops with a process each
    seconds: float  #: length of a window
    windows: int
    patience: float  #: s until all loops have to have answered


PLANS = {'quick': Plan((1, 10), (1, 3), 5.0, 1, 60.0),
         'default': Plan((1, 10, 50, 100, 200, 500), (1, 5, 20), 12.0, 2, 120.0)}


def measure(plan: Plan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure both ways, with more and more loops."""
    figures['meaning'] = MEANING
    for way, counts in (('processes', plan.processes), ('hosted', plan.hosted)):
        figures[way] = {}
        for count in counts:
            print(f'site: {count} {way}', file=sys.stderr, flush=True)
            figures[way][count] = _measured(way, count, plan)
        yield _table(way, figures[way])
    figures['gives_way'] = {way: _gives_way(figures[way]) for way in ('processes', 'hosted')}
    picture(folder / 'site.png', figures)
    yield '; '.join(f'{way}: {what}' for way, what in figures['gives_way'].items())


def _measured(way: str, count: int, plan: Plan) -> dict[str, Any]:
    names = [f'line_{k // 20 + 1}/reactor_{k % 20 + 1}' for k in range(count)]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        # as an operator would start them: on this machine, without the profile of the tests
        environment = {**stack.enter_context(isolated_domain()),
                       'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
        program = ('env', '-u', _PROFILE, sys.executable, '-m')
        loops = folder / 'loops.txt'
        loops.write_text('\n'.join(names))
        arguments = [('--', '--loops', str(loops))] if way == 'hosted' else [
            ('-r', f'__ns:=/{name}') for name in names]
        nodes = [NodeProcess('controller', {}, folder / f'{k}.log', environment,
                             ('--log-level', 'error', *more),
                             (*program, 'koopman_ros.nodes.controller'))
                 for k, more in enumerate(arguments)]
        for node in nodes:
            stack.callback(node.wait, _END)
            stack.callback(node.send, signal.SIGINT)
        given = {'settle': _SETTLE, 'seconds': plan.seconds, 'windows': plan.windows,
                 'patience': plan.patience}
        done = subprocess.run(
            [*program, 'validation.benchmarks.site_load', str(loops), '--pids',
             *(str(node.process.pid) for node in nodes),
             *(part for name, value in given.items() for part in (f'--{name}', str(value)))],
            stdout=subprocess.PIPE, text=True, check=True, env={**os.environ, **environment})
        found: dict[str, Any] = json.loads(done.stdout)
    for name in ('cores', 'load_cores', 'p50_ms', 'p99_ms'):
        found[name] = float(np.median([window[name] for window in found['windows']]))
    sent, answered = (sum(window[name] for window in found['windows'])
                      for name in ('sent', 'answered'))
    # what was sent at the end of a window is answered after it
    found['answered_share'] = min(1.0, answered / max(1, sent))
    return found


def _gives_way(found: dict[int, dict[str, Any]]) -> str:
    """Say which figure is the first that is not kept, and with how many loops."""
    for count, one in found.items():
        if one['answering'] < count:
            return f'the start, with {count} loops: {one["answering"]} answer in time'
        beyond = [name for name, most in HELD_TO.items() if not one[name] <= most]
        if beyond:
            return f'with {count} loops: ' + ', '.join(
                f'{name} {one[name]:.3g}, more than {HELD_TO[name]:g}' for name in beyond)
    return f'nothing up to {max(found)} loops'


def _table(way: str, found: dict[int, dict[str, Any]]) -> str:
    columns = ('pss_megabytes', 'rss_megabytes', 'cores', 'discovery_seconds',
               'start_cpu_seconds', 'p50_ms', 'p99_ms', 'answered_share')
    return table((way, 'answering', *columns), [
        (count, one['answering'], *(f'{one[column]:.3g}' for column in columns))
        for count, one in found.items()])


def picture(path: Path, figures: dict[str, Any]) -> None:
    """Draw how memory, processor, latency and start grow with the loops."""
    with drawing(path, 2, 2, size=(9.0, 7.0), sharex=True) as (figure, axes):
        for ax, (name, label) in zip(axes, _SIGNAL.items(), strict=True):
            _draw(ax, name, figures)
            ax.set(xscale='log', yscale='log', ylabel=label)
            if name in HELD_TO:
                draw_limits(ax, (HELD_TO[name],), 'held to with 100 hosted loops')
        for ax in axes[2:]:
            ax.set_xlabel('loops at 1 Hz')
        _finish(figure, axes)


def _draw(ax: Axes, name: str, figures: dict[str, Any]) -> None:
    for way, (colour, marker, label) in _STYLES.items():
        whole = {int(count): one[name] for count, one in figures[way].items()
                 if one['answering'] == int(count)}
        ax.plot(list(whole), list(whole.values()), color=colour, marker=marker, label=label)


def _finish(figure: Figure, axes: list[Axes]) -> None:
    counts = sorted({tick for ax in axes for line in ax.get_lines()[:2]
                     for tick in np.asarray(line.get_xdata()).tolist()})
    for ax in axes:
        ax.set_xticks(counts, [str(count) for count in counts])
        ax.minorticks_off()
    legend(figure, axes, 3)
