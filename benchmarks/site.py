# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Many loops at 1 Hz, hosted or in a process each: memory, processor, discovery, latency."""

from collections.abc import Iterator, Mapping
import contextlib
from dataclasses import dataclass
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from typing import Any, IO

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from koopman_ros.reports import draw_limits, drawing, legend, table
from koopman_ros.testing import isolated_domain, NodeProcess

PACKAGES = ('numpy', 'scipy', 'ros-jazzy-rclpy', 'ros-jazzy-rmw-fastrtps-cpp')
MEANING = {
    'processes': 'by number of loops: a controller process for each',
    'processes_with_plants': 'the same, with a process for the simulated plant of each',
    'hosted': 'by number of loops: all in one process, as `controller --loops` runs them',
    'hosted_with_plants': 'the same, with one process for all simulated plants',
    'hosts': 'by number of loops: in several processes, each of so many as `loops_of_a_host`',
    'domains': 'the same, each of these processes in a ROS domain of its own',
    'answering': 'loops that had answered when the patience for it was over',
    'discovery_seconds': 'from the start of the first process until every loop had answered',
    'start_cpu_seconds': 'processor time of all their processes until then',
    'cores': 'processor time of all their processes in a second; median of the windows',
    'p99_ms': '99th percentile from stamp to command, as the sensor sees it, or as who hears '
              'the commands where there are plants; median of the windows, of the domain that '
              'has the longest',
    'pss_megabytes': 'memory, with what processes share counted once',
    'gives_way': 'what is not kept first as loops are added, of what is held to',
}
HELD_TO = {'pss_megabytes': 400.0, 'cores': 0.5, 'p99_ms': 50.0}  # with 100 hosted loops
_SIGNAL = {'pss_megabytes': 'memory (PSS) [MB]', 'cores': 'processor [cores]',
           'p99_ms': 'stamp to command, p99 [ms]', 'discovery_seconds': 'until all answer [s]'}
_PERIOD = 1.0  # s between two measurements of a loop
_PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_SETTLE = 3.0  # s
_END = 60.0  # s; the middleware takes leave of each node


@dataclass(frozen=True)
class Way:
    """How loops are spread over processes."""

    label: str
    style: Mapping[str, Any]  #: of its line
    hosted: bool
    plants: bool = False  #: simulated plants in processes likewise; a sensor of ours otherwise
    several: bool = False  #: hosts, of `Plan.loops_of_a_host` each
    domains: bool = False  #: of their own


WAYS = {
    'processes': Way('a process each', {'color': 'tab:orange', 'marker': 's'}, False),
    'processes_with_plants': Way('a process each, and each plant', {
        'color': 'tab:orange', 'marker': 's', 'linestyle': '--', 'markerfacecolor': 'none'},
        False, plants=True),
    'hosted': Way('hosted by one process', {'color': 'tab:blue', 'marker': 'o'}, True),
    'hosted_with_plants': Way('hosted, and all plants by another', {
        'color': 'tab:blue', 'marker': 'o', 'linestyle': '--', 'markerfacecolor': 'none'},
        True, plants=True),
    'hosts': Way('hosted by several', {'color': 'tab:green', 'marker': '^'}, True, several=True),
    'domains': Way('hosted by several, a domain each', {'color': 'tab:red', 'marker': 'v'},
                   True, several=True, domains=True)}


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    loops: Mapping[str, tuple[int, ...]]  #: numbers of loops by way
    loops_of_a_host: int  #: where there are several
    seconds: float  #: length of a window
    windows: int
    patience: float  #: s until all loops have to have answered


PLANS = {
    'quick': Plan({'processes': (1, 3), 'hosted': (1, 10), 'hosted_with_plants': (10,),
                   'hosts': (10,), 'domains': (10,)}, 5, 5.0, 1, 60.0),
    'default': Plan({
        'processes': (1, 10, 20), 'processes_with_plants': (1, 10, 20),
        'hosted': (1, 10, 50, 100, 200, 500), 'hosted_with_plants': (1, 10, 50, 100),
        'hosts': (200, 500), 'domains': (200, 500)}, 100, 12.0, 2, 400.0)}


def measure(plan: Plan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure each way with more and more loops, up to the first that do not all start."""
    figures['meaning'] = MEANING
    figures['loops_of_a_host'] = plan.loops_of_a_host
    figures['gives_way'] = {}
    for name, counts in plan.loops.items():
        figures[name] = {}
        for count in counts:
            print(f'site: {name} {count}', file=sys.stderr, flush=True)
            figures[name][count] = _measured(WAYS[name], count, plan)
        figures['gives_way'][name] = _gives_way(figures[name])
        picture(folder / 'site.png', figures)
        yield _table(name, figures[name])
    yield '; '.join(f'{way}: {what}' for way, what in figures['gives_way'].items())


def _measured(way: Way, count: int, plan: Plan) -> dict[str, Any]:
    names = [f'line_{k // 20 + 1}/reactor_{k % 20 + 1}' for k in range(count)]
    size = 1 if not way.hosted else plan.loops_of_a_host if way.several else count
    groups = [names[k:k + size] for k in range(0, count, size)]
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        sites = [[group] for group in groups] if way.domains else [groups]
        loads = [_started(stack, way, site, folder / str(k), plan)
                 for k, site in enumerate(sites)]
        begun = [_told(load) for load in loads]
        for load in loads:
            assert load.stdin is not None
            load.stdin.write('all\n')
            load.stdin.flush()
        ended = [_told(load) for load in loads]
        for load in loads:
            load.wait()
    return _together(begun, ended)


def _started(stack: contextlib.ExitStack, way: Way, groups: list[list[str]], folder: Path,
             plan: Plan) -> subprocess.Popen[str]:
    """Start the processes of loops in one domain, and return what loads them."""
    folder.mkdir()
    # as an operator would start them: on this machine, without the profile of the tests
    environment = {**os.environ, **stack.enter_context(isolated_domain()),
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    program = ('env', '-u', _PROFILE, sys.executable, '-m')
    nodes = []
    for number, group in enumerate(groups):
        loops = folder / f'{number}.txt'
        loops.write_text('\n'.join(group))
        for kind in ('plant', 'controller') if way.plants else ('controller',):
            where = ('-r', f'{kind}_host:__node:=host_{number}', '--', '--loops', str(loops)
                     ) if way.hosted else ('-r', f'__ns:=/{group[0]}')
            given = {'sample_period': _PERIOD} if kind == 'plant' else {}
            nodes.append(NodeProcess(
                kind, given, folder / f'{number}_{kind}.log', environment,
                ('--log-level', 'error', *where), (*program, f'koopman_ros.nodes.{kind}')))
    for node in nodes:
        stack.callback(node.wait, _END)
    for node in nodes:
        stack.callback(node.send, signal.SIGINT)
    loops = folder / 'all.txt'
    loops.write_text('\n'.join(name for group in groups for name in group))
    options = {'settle': _SETTLE, 'seconds': plan.seconds, 'windows': plan.windows,
               'patience': plan.patience, 'period': _PERIOD}
    load = subprocess.Popen(
        [*program, 'benchmarks.site_load', str(loops), '--pids',
         *(str(node.process.pid) for node in nodes), *(['--plants'] if way.plants else []),
         *(part for name, value in options.items() for part in (f'--{name}', str(value)))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    stack.enter_context(load)
    stack.callback(load.terminate)
    return load


def _told(load: subprocess.Popen[str]) -> dict[str, Any]:
    output: IO[str] | None = load.stdout
    assert output is not None
    if not (line := output.readline()):
        raise RuntimeError(f'the load of the site has ended with status {load.wait()}')
    found: dict[str, Any] = json.loads(line)
    return found


def _together(begun: list[dict[str, Any]], ended: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a site from those of its domains."""
    found: dict[str, Any] = {
        **{name: sum(one[name] for one in begun) for name in ('answering', 'start_cpu_seconds')},
        'discovery_seconds': max(one['discovery_seconds'] for one in begun),
        **{name: sum(one[name] for one in ended) for name in ('pss_megabytes', 'rss_megabytes')},
        'windows': [one['windows'] for one in ended]}

    def of_domains(name: str) -> list[float]:
        return [float(np.median([window[name] for window in one])) for one in found['windows']]

    for name, over in (('cores', sum), ('load_cores', sum), ('p50_ms', max), ('p99_ms', max)):
        found[name] = over(of_domains(name))
    sent, answered = (sum(window[name] for one in found['windows'] for window in one)
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
        for ax, name in zip(axes, _SIGNAL, strict=True):
            draw_growth(ax, name, figures)
        for ax in axes[2:]:
            ax.set_xlabel('loops at 1 Hz')
        _finish(figure, axes)


def draw_growth(ax: Axes, name: str, figures: Mapping[str, Any]) -> None:
    """Draw one of the figures of each way over the number of loops."""
    for key, way in WAYS.items():
        whole = {int(count): one[name] for count, one in figures.get(key, {}).items()
                 if one['answering'] == int(count)}
        if whole:
            ax.plot(list(whole), list(whole.values()), label=way.label, **way.style)
    if name in HELD_TO:
        draw_limits(ax, (HELD_TO[name],), 'held to with 100 hosted loops')
    ax.set(xscale='log', yscale='log', ylabel=_SIGNAL[name])


def _finish(figure: Figure, axes: list[Axes]) -> None:
    counts = sorted({tick for ax in axes for line in ax.get_lines() if line.get_marker() != 'None'
                     for tick in np.asarray(line.get_xdata()).tolist()})
    for ax in axes:
        ax.set_xticks(counts, [str(count) for count in counts])
        ax.set_xticks([], minor=True)
    legend(figure, axes, 3)
