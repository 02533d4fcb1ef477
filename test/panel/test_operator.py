# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What an operator sees and does, in a real browser, of a loop whose messages a test sends."""

from collections.abc import Iterator
import contextlib
import re
from typing import Any

from playwright.sync_api import BrowserContext, expect, Locator, Page, WebSocketRoute
import pytest

from support.browser import Pages, PATIENCE
from support.operated import OperatedLoop
from support.users import PASSWORDS

# NiceGUI looks through all objects of the process for its server, also those of torch where
# another test has imported it.
pytestmark = pytest.mark.filterwarnings('ignore:.torch.distributed.reduce_op. is:FutureWarning')

DESK = (1000, 700)  # pixels


class Desk:
    """A browser in which an engineer is logged in, and the loop that its pages show."""

    def __init__(self, browser: Pages, served: Any, name: str = 'anna') -> None:
        expect.set_options(timeout=PATIENCE / 4.0)
        self._served, self.url = served, served.server.address
        self.context: BrowserContext = browser.context(*DESK)
        served.loop = OperatedLoop()
        page = self.context.new_page()
        page.goto(f'{self.url}/login')
        page.get_by_label('Name').fill(name)
        page.get_by_label('Password').fill(PASSWORDS[name])
        page.keyboard.press('Enter')
        page.wait_for_url(f'{self.url}/')
        page.close()

    @contextlib.contextmanager
    def page(self, path: str = '/', loop: OperatedLoop | None = None, *,
             routed: Any = None) -> Iterator[tuple[OperatedLoop, Page]]:
        """Show a page of a new loop."""
        self._served.loop = loop or OperatedLoop()
        page = self.context.new_page()
        if routed:
            page.route_web_socket('**', routed)
        page.goto(f'{self.url}{path}')
        page.wait_for_selector('#beat[data-beat]')
        try:
            yield self._served.loop, page
        finally:
            page.close()


@pytest.fixture(scope='module')
def desk(browser: Pages, served: Any) -> Iterator[Desk]:
    own = Desk(browser, served)
    yield own
    own.context.close()
    browser.forgive()


def asked(page: Page) -> Locator:
    return page.get_by_label('Set-point of temperature, °C', exact=True)


def face(page: Page, signal: str) -> Locator:
    return page.locator(f'[data-signal={signal}]')


def ready(page: Page) -> None:
    page.wait_for_function('window.did_handshake')
    expect(asked(page)).to_have_value(re.compile(r'\d'))


class Wire:
    """The connection of a page, which a test interrupts: messages wait, as in a network."""

    def __init__(self) -> None:
        self.cut = False
        self._waiting: list[Any] = []

    def __call__(self, route: WebSocketRoute) -> None:
        server = route.connect_to_server()
        route.on_message(lambda text: self._pass(server.send, text))
        server.on_message(lambda text: self._pass(route.send, text))

    def _pass(self, send: Any, text: Any) -> None:
        if self.cut:
            self._waiting.append((send, text))
        else:
            send(text)

    def mend(self) -> None:
        self.cut = False
        while self._waiting:
            send, text = self._waiting.pop(0)
            send(text)


def test_a_command_of_an_interrupted_connection_is_not_carried_out_and_the_page_says_so(
        desk: Desk) -> None:
    wire = Wire()
    with desk.page(routed=wire) as (loop, page):
        ready(page)
        asked(page).fill('46')
        asked(page).press('Enter')
        answer = face(page, 'temperature').locator('.answer')
        expect(answer).to_have_text('accepted')
        expect(asked(page)).to_have_value('46.0')
        wire.cut = True
        asked(page).fill('38')
        expect(face(page, 'temperature').locator('.ask')).to_have_class(re.compile('typed'))
        asked(page).press('Enter')
        # the answer to the one before is gone at once
        expect(answer).to_have_class(re.compile('pending'), timeout=500.0)
        expect(page.locator('#lost')).to_be_visible()
        page.wait_for_timeout(1500.0)
        wire.mend()
        expect(page.locator('#unsent')).to_contain_text(
            re.compile('Not sent: Set-point of temperature, °C = 38 '))
        expect(page.locator('#lost')).to_be_hidden()
        assert [action.value for action in loop.asked] == [46.0]
        # the value is still marked, and can be sent now
        expect(face(page, 'temperature').locator('.ask')).to_have_class(re.compile('typed'))
        asked(page).press('Enter')
        expect(face(page, 'temperature').locator('.value')).to_have_text('38.0 °C')
        page.get_by_role('button', name='Close').click()
        expect(page.locator('#unsent')).to_be_hidden()


def test_a_command_that_was_lost_is_named_after_the_page_was_loaded_again(desk: Desk) -> None:
    wire = Wire()
    with desk.page(routed=wire) as (loop, page):
        ready(page)
        wire.cut = True
        asked(page).fill('39')
        asked(page).press('Enter')
        expect(face(page, 'temperature').locator('.answer')).to_have_class(re.compile('pending'))
        wire.cut = False
        page.reload()
        expect(page.locator('#unsent')).to_contain_text('Not confirmed: Set-point of temperature')
        expect(asked(page)).to_have_value('45.0')
        assert not loop.asked


def test_an_answer_ends_when_another_set_point_holds(desk: Desk) -> None:
    with desk.page() as (loop, page):
        ready(page)
        asked(page).fill('46')
        asked(page).press('Enter')
        answer = face(page, 'temperature').locator('.answer')
        expect(answer).to_have_text('accepted')
        page.wait_for_timeout(2500.0)
        expect(answer).to_have_text('accepted')
        loop.request(type(loop.asked[0])('otto', 'setpoint', 'temperature', 47.0))
        expect(answer).to_have_text('')
