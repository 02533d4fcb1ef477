# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A real browser that notes what its pages complain of, and whom they ask."""

from collections.abc import Iterator
import contextlib
from pathlib import Path
import re

from playwright.sync_api import Browser, Page, sync_playwright
import pytest

CHROMIUM = Path('/usr/bin/chromium')
FLAGS = ('--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync')
PATIENCE = 60_000.0  # ms
ADDRESS = re.compile(r'the panel is at (http://127\.0\.0\.1:\d+)')
_OWN = re.compile(r'(http|ws)://127\.0\.0\.1:\d+/|data:|blob:')


class Pages:
    """Pages of a browser."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self.complaints: list[str] = []  #: errors in their consoles
        self.foreign: list[str] = []  #: addresses that are no panel's

    @contextlib.contextmanager
    def page(self, url: str, width: int = 1280, height: int = 800) -> Iterator[Page]:
        """Open a page as nobody has before."""
        context = self._browser.new_context(viewport={'width': width, 'height': height})
        context.set_default_timeout(PATIENCE)
        try:
            page = context.new_page()
            page.on('console', lambda message: self.complaints.append(message.text)
                    if message.type == 'error' else None)
            page.on('pageerror', lambda error: self.complaints.append(str(error)))
            page.on('request', lambda request: self._note(request.url))
            page.on('websocket', lambda socket: self._note(socket.url))
            page.goto(url)
            yield page
        finally:
            context.close()

    def _note(self, url: str) -> None:
        if not _OWN.match(url):
            self.foreign.append(url)


@contextlib.contextmanager
def opened_browser() -> Iterator[Pages]:
    """Start a browser; the end asserts that no page complained, and none asked others."""
    if not CHROMIUM.exists():
        pytest.fail('the tests in a browser need Chromium: sudo apt-get install chromium')
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=str(CHROMIUM), headless=True, args=list(FLAGS))
        try:
            pages = Pages(browser)
            yield pages
            assert (pages.complaints, pages.foreign) == ([], [])
        finally:
            browser.close()
