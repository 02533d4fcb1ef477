# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The operator's panel in a real browser, beside a loop that runs ten times as fast as the clock.

The loop is that of ``make demo PANEL=1``, in which the reactor measures ten times a second. The
panel hears all of it but the temperature: that comes from here, once for each measurement and with
its stamp, so that no two numbers within twenty seconds are written alike, and at random within
the period, so that it is in step with none of the panel's own clocks. The page notes when the
number on the faceplate changes (MutationObserver); the screen has it with the next frame. The
delay of a message is that until its number, or that of a later message, is there. It includes
the panel's looks at the loop, five times a second, and the pages' at the panel, four times.

All pages but the first read what is sent and draw nothing (:mod:`light_pages`): twenty browsers on
the machine of the panel would be all that is measured. The panel sends to all of them alike.

The answer of the controller goes by the stamps that the middleware gives to measurement and
command when they are sent: a busy browser or bench does not blur it.
"""

from collections.abc import Callable, Iterator
import contextlib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tempfile
import time
from typing import Any, TYPE_CHECKING

import numpy as np
import psutil
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Temperature

from benchmarks.process import processor_seconds
from koopman_ros.demo import reactor
from koopman_ros.reports import table
from koopman_ros.ros import topics
from koopman_ros.ros.codec import stamp_nanoseconds
from koopman_ros.testing import Harness, NodeProcess
from koopman_ros.units import NANOSECONDS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

PACKAGES = ('nicegui', 'playwright')
MEANING = {
    'delay': 'from a message sent to its number, or a later one, on the faceplate; of_shown: of '
             'those messages alone whose own number was shown',
    'pages': 'that were connected in the end, as the panel says',
    'cpu_share': "of one core, the panel's process",
    'waiting_share': 'of the time, in which a thread of the panel was ready and others had the '
                     'cores: of the thread that waited most; null where the system does not tell',
    'pss_megabytes': "the panel's memory, shared pages by halves, thirds, ...; rss counts them in "
                     'whole',
    'machine_share': 'of all cores, all that ran on the machine meanwhile, the browser too',
    'answer': 'from a measurement sent by the plant to its command sent by the controller',
    'first_load': 'by a browser that has nothing of the panel yet: bytes as they are transferred, '
                  'requests without the web socket, seconds until the faceplate shows a number',
}
_SPEED, _PERIOD = 10.0, 1.0  # of the plant, and s of plant time between measurements
_LOWEST, _STEP, _NUMBERS = 32.0, 0.1, 200  # of what the panel is told, in degrees Celsius
_TOLD = 'told_temperature'
_FRESH = 0.05  # s, of a measurement that has not waited here
_LAST = 0.7  # s for the last message to be shown
_END = 10.0  # s for pages to close
_SETTLE = 1.0  # s from the last page to the figures
_PATIENCE = 60_000.0  # ms for a page
_FLAGS = ('--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
          '--disable-background-networking', '--disable-component-update', '--disable-sync')
_ADDRESS = re.compile(r'the panel is at (\S+)')
# in ms: of the wall clock, since the navigation began, and the number
_WATCH = """
window.seen = [];
new MutationObserver(() => {
  const text = document.querySelector('[data-signal=temperature] .big')?.textContent;
  const last = window.seen.at(-1)?.[2];
  if (text && text !== last && !isNaN(text)) {
    const now = performance.now();
    window.seen.push([performance.timeOrigin + now, now, text]);
  }
}).observe(document, {subtree: true, childList: true, characterData: true});
"""


@dataclass(frozen=True)
class Plan:
    """One extent of the measurements."""

    seconds: float  #: of each measurement: without the panel, with one page, with all
    pages: int  #: that are open in the end
    loads: int  #: by new browsers


PLANS = {'quick': Plan(10.0, 20, 2), 'default': Plan(60.0, 20, 5)}


def measure(plan: Plan, figures: dict[str, Any], folder: Path) -> Iterator[str]:
    """Measure the loop alone, the first page, one page and many; or say what is missing."""
    figures['meaning'] = MEANING
    if missing := _missing():
        figures['not_measured'] = missing
        yield f'the panel is not measured: {missing}'
        return
    from playwright.sync_api import sync_playwright

    with (tempfile.TemporaryDirectory() as name, Harness(Path(name)) as harness,
          sync_playwright() as playwright):
        loop = _Loop(harness, Path(name))
        _tell(f'{plan.seconds:g} s without the panel')
        figures['without_panel'] = {'answer': loop.answers(plan.seconds)}
        panel, address = loop.start_panel()
        browser = playwright.chromium.launch(
            executable_path=_chromium(), headless=True, args=list(_FLAGS))
        try:
            yield _first_load(figures, loop, browser, address, plan.loads)
            yield _all_pages(figures, loop, browser, panel, address, plan)
        finally:
            browser.close()


def _tell(label: str) -> None:
    print(f'panel: {label}', file=sys.stderr, flush=True)


def _chromium() -> str | None:
    return shutil.which('chromium') or shutil.which('chromium-browser')


def _missing() -> str:
    """Say what this part needs and does not find, or nothing."""
    for package in ('nicegui', 'playwright'):
        if find_spec(package) is None:
            return f'{package} is missing: pip install {package}'
    return '' if _chromium() else 'Chromium is missing: sudo apt-get install chromium'


class _Loop:
    """Plant, controller and trainer in lock-step, and what the panel is told of them."""

    def __init__(self, harness: Harness, folder: Path) -> None:
        self.harness = harness
        self._rng = np.random.default_rng(0)
        self._sent: list[dict[int, int]] = [{}, {}]  # measurements and commands: stamp -> sent
        self._pending: Temperature | None = None
        self._due, self._latest = 0.0, 0
        self.told: list[int] = []  # when the numbers, one after the other [ns of time.time_ns]
        self._telling = harness.node.create_publisher(Temperature, _TOLD, topics.LOOP_QOS)
        listeners: tuple[tuple[str, Callable[..., None]], ...] = (
            (reactor.TEMPERATURE, self._on_measurement),
            (reactor.COOLANT_SETPOINT, self._on_command))
        for topic, hear in listeners:
            harness.node.create_subscription(Temperature, topic, hear, QoSProfile(depth=1000))
        harness.start('controller')
        harness.start('trainer', {'output': folder / 'run'})
        # controller, trainer and the bench
        harness.start('plant', {'speed': _SPEED, 'lockstep': True, 'sample_period': _PERIOD,
                                'lockstep_subscribers': 3})
        harness.wait_until(lambda: len(self._sent[1]) > 3, 'the loop runs')

    def _on_measurement(self, message: Temperature, about: dict[str, int]) -> None:
        self._latest = about['source_timestamp']
        self._sent[0][stamp_nanoseconds(message.header.stamp)] = self._latest
        self._tell_panel()
        self._pending = message
        self._due = time.monotonic() + self._rng.uniform(0.0, _PERIOD / _SPEED)

    def _on_command(self, message: Temperature, about: dict[str, int]) -> None:
        self._sent[1][stamp_nanoseconds(message.header.stamp)] = about['source_timestamp']

    def _tell_panel(self) -> None:
        if self._pending is not None:
            number = len(self.told) % _NUMBERS
            self._pending.temperature = round(_LOWEST + _STEP * number, 1)
            self.told.append(time.time_ns())
            self._telling.publish(self._pending)
            self._pending = None

    def run(self, seconds: float) -> None:
        """Let the loop run for some seconds of the clock, and tell the panel of it."""
        end = time.monotonic() + seconds

        def over() -> bool:
            now = time.monotonic()
            if now >= self._due:
                self._tell_panel()
            wait = min(end, self._due if self._pending is not None else end) - now
            self.harness.spin_once(min(max(wait, 0.0), 0.02))
            return now >= end

        self.harness.wait_until(over)

    def settle(self) -> None:
        """Let the loop run for a while, until nothing is left that came in before."""
        self.run(_SETTLE)
        self.harness.wait_until(lambda: time.time_ns() - self._latest < _FRESH * NANOSECONDS)

    def answers(self, seconds: float, beside: Callable[[], None] | None = None
                ) -> dict[str, float]:
        """Let the loop run; return how quick the controller answered meanwhile."""
        for sent in self._sent:
            sent.clear()
        self.run(seconds)
        if beside is not None:
            beside()
        # one that waits for its answer at the end
        self.run(0.2)
        measurements, commands = self._sent
        return _quantiles([(commands[stamp] - sent) / NANOSECONDS
                           for stamp, sent in measurements.items() if stamp in commands])

    @property
    def pages(self) -> int:
        """How many pages are connected, as the panel has said last."""
        status = self.harness.last_status('panel: pages')
        return 0 if status is None else int(
            {item.key: item.value for item in status.values}['pages'])

    def start_panel(self) -> tuple[NodeProcess, str]:
        """Start a panel that hears the temperature from here; return it with its address."""
        panel = self.harness.start('panel', {'port': 0}, ('-r', f'temperature:={_TOLD}'))
        found = self.harness.wait_until(lambda: _ADDRESS.search(panel.output()), 'the panel')
        assert found is not None
        self.harness.wait_until(lambda: self._telling.get_subscription_count() > 0)
        return panel, found[1]


def _first_load(figures: dict[str, Any], loop: _Loop, browser: 'Browser', address: str,
                loads: int) -> str:
    """Open the page by browsers that are new each time."""
    _tell(f'the first page, {loads} times')
    runs = []
    for _ in range(loads):
        loop.run(0.2)
        with contextlib.closing(_profile(browser)) as profile:
            page = profile.new_page()
            network = profile.new_cdp_session(page)
            sizes: list[float] = []
            asked: list[str] = []
            network.on('Network.loadingFinished',
                       lambda event, sizes=sizes: sizes.append(event['encodedDataLength']))
            network.on('Network.requestWillBeSent',
                       lambda event, asked=asked: asked.append(event['request']['url']))
            network.send('Network.enable')
            _open(loop, page, address)
            page.wait_for_load_state('networkidle')
            runs.append({'seconds': page.evaluate('window.seen[0][1]') / 1e3,
                         'kilobytes': sum(sizes) / 1e3,
                         'requests': sum(url.startswith('http') for url in asked)})
    found = figures['first_load'] = {
        name: float(np.median([run[name] for run in runs])) for name in runs[0]}
    found['runs'] = runs
    return (f'first load: {found["kilobytes"]:.0f} kB in {found["requests"]:.0f} requests, a '
            f'number after {found["seconds"]:.2f} s')


def _profile(browser: 'Browser') -> 'BrowserContext':
    profile = browser.new_context(viewport={'width': 1280, 'height': 800})
    profile.set_default_timeout(_PATIENCE)
    profile.add_init_script(_WATCH)
    return profile


def _open(loop: _Loop, page: 'Page', address: str) -> None:
    """Open the overview, and wait for a number that is not too old to be shown."""
    page.goto(address)
    deadline = time.monotonic() + _PATIENCE / 1e3
    while not page.evaluate('window.seen.length'):
        if time.monotonic() > deadline:
            raise RuntimeError('no number on the faceplate')
        loop.run(0.05)


def _all_pages(figures: dict[str, Any], loop: _Loop, browser: 'Browser', panel: NodeProcess,
               address: str, plan: Plan) -> str:
    """Open a page, and then the others beside it; take the figures of both."""
    page = _profile(browser).new_page()
    _open(loop, page, address)
    with contextlib.ExitStack() as stack:
        for name, count in (('one_page', 1), ('all_pages', plan.pages)):
            if count > 1:
                stack.enter_context(_light_pages(address, count - 1))
            _tell(f'{plan.seconds:g} s with {count} open')
            # its diagnostics come once a second
            deadline = time.monotonic() + _PATIENCE / 1e3
            while loop.pages != count and time.monotonic() < deadline:
                loop.run(0.1)
            loop.settle()
            figures[name] = {'opened': count, **_figures(loop, page, panel, plan.seconds)}
    rows = [('none', '', '', '', '', _milliseconds(figures['without_panel']['answer']))]
    for name in ('one_page', 'all_pages'):
        one = figures[name]
        connected = '' if one['pages'] == one['opened'] else f', {one["pages"]} connected'
        rows.append((f'{one["opened"]}{connected}', _milliseconds(one['delay']),
                     f'{one["cpu_share"]:.1%}', f'{one["pss_megabytes"]:.0f}',
                     f'{one["machine_share"]:.0%}', _milliseconds(one['answer'])))
    return table(('pages', 'delay, median / p99 [ms]', 'panel, of a core', 'PSS [MB]',
                  'machine', 'answer, median / p99 [ms]'), rows)


@contextlib.contextmanager
def _light_pages(address: str, count: int) -> Iterator[None]:
    """Hold pages open that draw nothing."""
    held = subprocess.Popen(
        [sys.executable, '-m', 'benchmarks.light_pages', address, str(count)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert held.stdin is not None
    assert held.stdout is not None
    try:
        if held.stdout.readline() != b'connected\n':
            raise RuntimeError(f'{count} pages could not be opened at {address}')
        yield
        if held.poll() is not None:
            raise RuntimeError('the panel closed a page')
    finally:
        held.stdin.close()
        try:
            held.wait(_END)
        except subprocess.TimeoutExpired:
            held.kill()
            held.wait()
        held.stdout.close()


def _figures(loop: _Loop, page: 'Page', panel: NodeProcess, seconds: float) -> dict[str, Any]:
    """Watch panel and loop for some seconds while pages are open."""
    process = psutil.Process(panel.process.pid)
    found: dict[str, Any] = {}
    first, begun = len(loop.told), time.monotonic()
    before, waited = processor_seconds(process.pid), _waited(process)
    psutil.cpu_percent()

    def take() -> None:
        after, took = processor_seconds(process.pid), time.monotonic() - begun
        memory = process.memory_full_info()
        found.update(
            pages=loop.pages,
            cpu_share=(after - before) / took,
            waiting_share=max((ready - waited.get(thread, 0.0) for thread, ready in _waited(
                process).items()), default=np.nan) / took,
            pss_megabytes=memory.pss / 1e6, rss_megabytes=memory.rss / 1e6,
            machine_share=psutil.cpu_percent() / 1e2)

    answer, last = loop.answers(seconds, take), len(loop.told)
    loop.run(_LAST)
    return {**found, 'answer': answer, 'delay': _delays(loop.told, first, last, page.evaluate(
        'window.seen'))}


def _waited(process: psutil.Process) -> dict[str, float]:
    """Return the s in which each thread of a process was ready to run, and did not."""
    found = {}
    for path in Path(f'/proc/{process.pid}/task').glob('*/schedstat'):
        # threads end
        with contextlib.suppress(OSError, IndexError):
            found[path.parent.name] = int(path.read_text().split()[1]) / NANOSECONDS
    return found


def _delays(told: list[int], first: int, last: int, seen: list[list[Any]]
            ) -> dict[str, Any]:
    """Return the delays of messages of a range, by what the page noted down."""
    sent = np.array(told) / NANOSECONDS
    every: list[float] = []
    own: list[float] = []
    next_one = first
    for moment, _, text in seen:
        at = moment / 1e3
        # the last message before, of those with this number
        latest = int(np.searchsorted(sent, at)) - 1
        number = round((float(text) - _LOWEST) / _STEP)
        shown = latest - (latest - number) % _NUMBERS
        if next_one <= shown < last:
            own.append(at - sent[shown])
        every += [at - sent[k] for k in range(next_one, min(shown + 1, last))]
        next_one = max(next_one, shown + 1)
    return {**_quantiles(every), 'not_shown': max(0, last - next_one),
            'of_shown': _quantiles(own)}


def _quantiles(seconds: list[float]) -> dict[str, float]:
    if not seconds:
        return {'count': 0, 'median_ms': np.nan, 'p99_ms': np.nan}
    median, p99 = np.percentile(1e3 * np.array(seconds), (50, 99))
    return {'count': len(seconds), 'median_ms': float(median), 'p99_ms': float(p99)}


def _milliseconds(found: dict[str, float]) -> str:
    return f'{found["median_ms"]:.3g} / {found["p99_ms"]:.3g}'
