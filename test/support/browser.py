# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A real browser that notes what its pages complain of, and whom they ask."""

from collections.abc import Callable, Iterator
import contextlib
import re
import shutil
import time

from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright
import pytest

from support import INSTALL_CHROMIUM

PATIENCE = 60_000.0  # ms
ADDRESS = re.compile(r'the panel is at (http://127\.0\.0\.1:\d+)')
# The address bar has two pages of its own, which each window would load, where there is no bar.
# The rest is what Playwright turns off, for the last list alone counts.
_OFF = ('WebUIOmniboxPopup', 'WebUIOmniboxAimPopup', 'AimEnabled',
        'AvoidUnnecessaryBeforeUnloadCheckSync', 'DestroyProfileOnBrowserClose', 'HttpsUpgrades',
        'HttpsFirstBalancedModeAutoEnable', 'LensOverlay', 'MediaRouter', 'PaintHolding',
        'ThirdPartyStoragePartitioning', 'AvoidCorsURLLoaderRestartOnRedirect',
        'OptimizationHints', 'NetworkTimeServiceQuerying', 'PreconnectToSearch')
_FLAGS = (f'--disable-features={",".join(_OFF)}',
          '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run', '--mute-audio',
          '--disable-extensions', '--disable-background-networking', '--disable-component-update',
          '--disable-sync', '--in-process-gpu', '--renderer-process-limit=1')
_OWN = re.compile(r'(http|ws)://127\.0\.0\.1:\d+/|data:|blob:')


class Pages:
    """Pages of a browser."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._complaints: list[str] = []  # errors in their consoles
        self._foreign: list[str] = []  # addresses that are no panel's

    def context(self, width: int = 1280, height: int = 800) -> BrowserContext:
        """Return another browser, as far as a panel can tell."""
        context = self._browser.new_context(
            viewport={'width': width, 'height': height}, reduced_motion='reduce')
        context.set_default_timeout(PATIENCE)
        context.on('console', lambda message: self._complaints.append(message.text)
                   if message.type == 'error' else None)
        context.on('weberror', lambda error: self._complaints.append(str(error.error)))
        context.on('request', lambda request: self._note(request.url))
        context.on('page', lambda page: page.on('websocket', lambda own: self._note(own.url)))
        return context

    @contextlib.contextmanager
    def page(self, url: str) -> Iterator[Page]:
        """Open a page as nobody has before."""
        context = self.context()
        try:
            page = context.new_page()
            page.goto(url)
            yield page
        finally:
            context.close()

    def check(self) -> None:
        """Assert that no page has complained since the last time, and none has asked others."""
        complaints, self._complaints = self._complaints, []
        foreign, self._foreign = self._foreign, []
        assert (complaints, foreign) == ([], [])

    def forgive(self) -> None:
        """Pass over what pages have complained of since the last time."""
        self._complaints = []

    def _note(self, url: str) -> None:
        if not _OWN.match(url):
            self._foreign.append(url)


def repeat_until(acted: Callable[[], bool], act: Callable[[], object]) -> None:
    """Act, which may be ignored once, until it has an effect on a page."""
    deadline = time.monotonic() + PATIENCE / 1e3
    while not acted():
        assert time.monotonic() < deadline
        act()


@contextlib.contextmanager
def opened_browser() -> Iterator[Pages]:
    """Start a browser; the end asserts that no page complained, and none asked others."""
    chromium = shutil.which('chromium')
    if chromium is None:
        pytest.skip(f'needs Chromium: {INSTALL_CHROMIUM}')
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, headless=True, args=list(_FLAGS))
        try:
            pages = Pages(browser)
            yield pages
            pages.check()
        finally:
            browser.close()
