# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The web server: strangers, proxies, several panels, and pages of other users."""

from collections.abc import Callable, Iterator
import contextlib
from dataclasses import replace
from email.message import Message
import http.client
import json
import logging
import math
import os
import re
import resource
import socket
import threading
import time
from typing import Any, NamedTuple
from urllib.parse import urlencode

from nicegui import Client
import numpy as np
from playwright.sync_api import expect, Page, WebSocketRoute
import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from koopman_ros.panel import server, trend_chart
from koopman_ros.panel.access import Users
from koopman_ros.panel.connections import Listener, RateLimiter
from koopman_ros.panel.layout import clock
from koopman_ros.panel.server import PanelServer
from koopman_ros.panel.trend_chart import axis_ends, ink, legend_rows, zoomed
from koopman_ros.panel.trend_page import time_of_day
from support.browser import Pages, PATIENCE, repeat_until
from support.hostile import HostileSource, NOW, TEXTS
from support.users import PASSWORDS

# NiceGUI looks through all objects of the process for its server, also those of torch where
# another test has imported it.
pytestmark = pytest.mark.filterwarnings('ignore:.torch.distributed.reduce_op. is:FutureWarning')

HOST = 'panel.example'
PROXY, OTHER = '127.0.0.1', '127.0.0.9'
TIMEOUT = 120.0


class Answered(NamedTuple):
    status: int
    headers: Message
    content: str


class Site:
    """A panel with users, in a thread of this process."""

    def __init__(self, served: Any) -> None:
        self.source = served.loop = HostileSource()
        self.server: PanelServer = served.server
        self.url = self.server.address
        self.port = int(self.url.rpartition(':')[2])

    def ask(self, method: str, path: str, body: str | None = None, *, source: str = OTHER,
            host: str = '', **headers: str) -> Answered:
        """Ask from an address of this machine, which may be that of the proxy."""
        own = http.client.HTTPConnection('127.0.0.1', self.port, TIMEOUT, (source, 0))
        kind = {'Content-Type': 'application/x-www-form-urlencoded'} if body is not None else {}
        own.request(method, path, body, {
            **kind, 'Host': host or f'127.0.0.1:{self.port}',
            **{name.replace('_', '-'): text for name, text in headers.items()}})
        answer = own.getresponse()
        found = Answered(answer.status, answer.headers, answer.read().decode())
        own.close()
        return found

    def log_in(self, name: str, password: str = '', **details: str) -> Answered:
        return self.ask('POST', '/login', urlencode(
            {'name': name, 'password': password or PASSWORDS.get(name, '')}), **details)

    def cookie(self, name: str) -> str:
        return self.log_in(name).headers['set-cookie'].split(';')[0]


@pytest.fixture(scope='module')
def site(served: Any) -> Site:
    return Site(served)


def forwarded(client: str, scheme: str = 'https') -> dict[str, str]:
    """Return what a proxy adds to a request."""
    return {'host': HOST, 'X_Forwarded_For': client, 'X_Forwarded_Proto': scheme,
            'Origin': f'{scheme}://{HOST}'}


# Proxies.


def test_users_log_in_through_a_proxy_with_tls(site: Site) -> None:
    answer = site.log_in('anna', source=PROXY, **forwarded('10.1.0.1'))
    assert answer.status == 303
    cookie, *rules = answer.headers['set-cookie'].split('; ')
    assert {'secure', 'httponly', 'samesite=strict'} <= set(rules)
    answer = site.ask('GET', '/', source=PROXY, host=HOST, Cookie=cookie,
                      X_Forwarded_Proto='https')
    assert answer.status == 200
    with socketed(site, cookie, page_id(answer.content), source=PROXY, host=HOST,
                  origin=f'https://{HOST}', more={'X-Forwarded-Proto': 'https'}) as told:
        assert told.accepted is True
    # without TLS at the proxy there is no such rule for the cookie
    answer = site.log_in('anna', source=PROXY, **forwarded('10.1.0.1', 'http'))
    assert 'secure' not in answer.headers['set-cookie']


def test_headers_of_a_proxy_are_believed_from_its_address_alone(site: Site) -> None:
    answer = site.log_in('anna', source=OTHER, **forwarded('10.1.0.2'))
    assert answer.status == 403
    assert 'trusted_proxy' in answer.content
    assert site.log_in('anna', source=PROXY, **{
        **forwarded('10.1.0.2'), 'Origin': 'https://elsewhere'}).status == 403


def test_wrong_log_ins_through_a_proxy_delay_their_own_address_alone(site: Site) -> None:
    def wrong(client: str) -> list[int]:
        return [site.log_in('olga', 'wrong', source=PROXY, **forwarded(client)).status
                for _ in range(6)]

    assert wrong('10.2.0.1') == [401] * 5 + [429]
    # a browser may send the header as well: what the proxy adds to it counts
    assert wrong('1.2.3.4, 10.2.0.1') == [429] * 6
    assert site.log_in('olga', source=PROXY, **forwarded('10.2.0.2')).status == 303
    assert site.log_in('olga').status == 303


# Several panels.


def test_the_cookie_is_that_of_this_panel(site: Site) -> None:
    name = site.cookie('anna').partition('=')[0]
    assert re.fullmatch(rf'koopman_panel_{site.port}_[0-9a-f]{{8}}', name)
    token = site.cookie('anna').partition('=')[2]
    # the browser sends those of other panels of this host as well
    other = f'koopman_panel_{site.port + 1}_00000000=x; koopman_panel=y'
    assert site.ask('GET', '/', Cookie=f'{other}; {name}={token}').status == 200
    for cookie in (f'{other}; koopman_panel_1={token}', f'{name}={token}x', f'{name}=x{token}',
                   f'{name}=eyJpZCI6ICJ4In0=.x.y', f'{name}='):
        assert site.ask('GET', '/', Cookie=cookie).status == 303


def test_a_log_out_ends_the_session_and_not_those_of_other_browsers(site: Site) -> None:
    own, other = site.cookie('anna'), site.cookie('anna')
    answer = site.ask('GET', '/logout', Cookie=own)
    assert answer.status == 303
    assert 'expires=Thu, 01 Jan 1970' in answer.headers['set-cookie']
    # the cookie is still signed, but its session has ended
    assert site.ask('GET', '/', Cookie=own).status == 303
    assert site.ask('GET', '/', Cookie=other).status == 200


# Pages of other users.


def page_id(text: str) -> str:
    found = re.search(r'client_id\W+([0-9a-f-]{36})', text)
    assert found is not None
    return found[1]


def opened(site: Site, cookie: str, query: dict[str, str], source: str, host: str, origin: str,
           more: dict[str, str]) -> ClientConnection:
    host = host or f'127.0.0.1:{site.port}'
    return connect(
        f'ws://{host}/_nicegui_ws/socket.io/?' + urlencode(
            {'EIO': '4', 'transport': 'websocket', **query}),
        sock=socket.create_connection(('127.0.0.1', site.port), TIMEOUT, (source, 0)),
        additional_headers={'Cookie': cookie, **more}, origin=Origin(origin or f'http://{host}'))


def received(own: ClientConnection) -> str:
    return own.recv(TIMEOUT, decode=True)


class Told(NamedTuple):
    accepted: object
    socket: ClientConnection


@contextlib.contextmanager
def socketed(site: Site, cookie: str, client_id: str, *, source: str = OTHER, host: str = '',
             origin: str = '', more: dict[str, str] | None = None) -> Iterator[Told]:
    """Open a socket and ask to be that of a page."""
    with opened(site, cookie, {}, source, host, origin, more or {}) as own:
        assert received(own).startswith('0{')
        own.send('40')
        assert received(own).startswith('40')
        own.send('420' + json.dumps(['handshake', {
            'client_id': client_id, 'tab_id': 'tab', 'document_id': 'document',
            'next_message_id': 0}]))
        while not (answer := received(own)).startswith('430'):
            if answer == '2':
                own.send('3')
        yield Told(json.loads(answer.removeprefix('430'))[0], own)


def test_the_id_of_a_page_opens_it_to_its_own_session_alone(site: Site) -> None:
    anna = site.cookie('anna')
    page = page_id(site.ask('GET', '/', Cookie=anna).content)
    for other in (site.cookie('otto'), site.cookie('olga'), site.cookie('anna')):
        with socketed(site, other, page) as told:
            assert told.accepted is False
        with opened(site, other, {
                'client_id': page, 'implicit_handshake': 'true', 'tab_id': 'tab',
                'document_id': 'document', 'next_message_id': '0'}, OTHER, '', '', {}) as own:
            assert received(own).startswith('0{')
            own.send('40')
            assert received(own).startswith('44'), 'the connection is rejected'
    with socketed(site, anna, page) as told:
        assert told.accepted is True




def test_events_of_another_user_do_not_reach_a_page(site: Site) -> None:
    """The same events do where its own user sends them."""
    anna, otto = site.cookie('anna'), site.cookie('otto')
    text = site.ask('GET', '/model', Cookie=anna).content
    page = page_id(text)
    (train,) = (own for own in Client.instances[page].elements.values()
                if getattr(own, 'text', '') == 'Train')
    (listener,) = (own.id for own in train._event_listeners.values() if own.type == 'click')
    click = '42' + json.dumps(['event', {
        'id': train.id, 'client_id': page, 'listener_id': listener, 'args': []}])

    def sent(cookie: str) -> None:
        with socketed(site, cookie, page) as (_, own):
            for junk in ('[]', '{"client_id": []}', '{}', '7', 'null'):
                own.send(f'42["event",{junk}]')
            own.send(click)
            # answered after it
            own.send('421' + json.dumps(['handshake', {'client_id': 'none'}]))
            while not received(own).startswith('431'):
                pass

    with socketed(site, anna, page):
        sent(otto)
        assert not site.source.asked
    sent(anna)
    until(lambda: [(one.who, one.what) for one in site.source.asked] == [('anna', 'train')])


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_open_pages_of_a_user_are_bounded(
        site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, 'MAX_SOCKETS', 2)
    olga = site.cookie('olga')

    def answer(own: ClientConnection) -> str:
        assert received(own).startswith('0{')
        own.send('40')
        return received(own)[:2]

    with contextlib.ExitStack() as stack:
        def connected(cookie: str) -> str:
            return answer(stack.enter_context(opened(site, cookie, {}, OTHER, '', '', {})))

        assert [connected(olga) for _ in range(3)] == ['40', '40', '44']
        assert connected(site.cookie('anna')) == '40'
    # those that are closed do not count
    with contextlib.ExitStack() as stack:
        until(lambda: connected(olga) == '40')


def test_the_page_to_log_in_does_not_wait_for_passwords_that_are_verified(
        site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    over = threading.Event()
    begun: list[str] = []

    def verify(own: Users, name: str, password: str) -> None:
        begun.append(name)
        assert over.wait(TIMEOUT)

    monkeypatch.setattr(Users, 'verify', verify)
    tries = [threading.Thread(target=lambda at=at: site.log_in(
        'olga', 'wrong', source=PROXY, **forwarded(f'10.9.0.{at}'))) for at in range(60)]
    try:
        for one in tries:
            one.start()
        until(lambda: len(begun) == 1)
        assert site.ask('GET', '/login').status == 200
        assert len(begun) == 1
    finally:
        over.set()
        for one in tries:
            one.join()


def test_sockets_are_websockets_alone(site: Site) -> None:
    """The id of one that polls would be a credential."""
    for method in ('GET', 'POST'):
        answer = site.ask(method, '/_nicegui_ws/socket.io/?EIO=4&transport=polling',
                          Cookie=site.cookie('anna'))
        assert answer.status == 403


# Strangers.


def half_open(site: Site, count: int, stack: contextlib.ExitStack, said: bytes) -> None:
    for _ in range(count):
        own = stack.enter_context(socket.create_connection(('127.0.0.1', site.port), TIMEOUT))
        own.sendall(said)


@pytest.mark.parametrize('said', [
    b'', b'GET / HTTP/1.1\r\nX: ',
    b'POST /login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100\r\nContent-Type: '
    b'application/x-www-form-urlencoded\r\n\r\nname='])
def test_unfinished_requests_do_not_block_others(site: Site, said: bytes) -> None:
    anna = site.cookie('anna')
    before = len(os.listdir('/proc/self/fd'))
    with contextlib.ExitStack() as stack:
        half_open(site, 400, stack, said)
        assert site.ask('GET', '/login').status == 200
        assert site.ask('GET', '/', Cookie=anna).status == 200
        # those of this test, and those of the panel
        until(lambda: len(os.listdir('/proc/self/fd')) - before <= 400 + 256)


def test_the_oldest_unused_connection_is_closed_and_a_used_one_never() -> None:
    with Listener(socket.AF_INET, socket.SOCK_STREAM, most=2) as own, \
            contextlib.ExitStack() as stack:
        own.bind(('127.0.0.1', 0))
        own.listen(8)

        def connected() -> socket.socket:
            client = stack.enter_context(socket.create_connection(own.getsockname(), TIMEOUT))
            accepted, address = own.accept()
            stack.enter_context(accepted)
            served.append(address)
            return client

        served: list[tuple[str, int]] = []
        used = connected()
        with own.serving(served[0]):
            first = connected()
            connected()
            assert first.recv(1) == b''
            used.settimeout(0.0)
            with pytest.raises(BlockingIOError):
                used.recv(1)
            # all are used
            with own.serving(served[2]), socket.create_connection(
                    own.getsockname(), TIMEOUT) as late:
                with pytest.raises(ConnectionAbortedError):
                    own.accept()
                assert late.recv(1) == b''


def test_a_process_that_may_open_few_files_has_fewer_connections(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, 'getrlimit', lambda _: (256, 256))
    with Listener(socket.AF_INET, socket.SOCK_STREAM) as own:
        assert own.most == 64


def test_a_log_has_so_many_lines_in_a_period(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger('test.seldom')
    log.addFilter(RateLimiter())
    for number in range(100):
        log.error('line %d', number)
    messages = [record.getMessage() for record in caplog.records]
    assert messages[:19] == [f'line {number}' for number in range(19)]
    assert len(messages) == 20
    assert 'further lines are dropped' in messages[-1]


# In a browser.


def log_in(page: Page, site: Site) -> None:
    page.goto(f'{site.url}/login')
    page.get_by_label('Name').fill('anna')
    page.get_by_label('Password').fill(PASSWORDS['anna'])
    page.keyboard.press('Enter')
    page.wait_for_url(f'{site.url}/')


def test_no_text_from_outside_runs_in_the_browser(site: Site, browser: Pages) -> None:
    with browser.page('about:blank') as page:
        log_in(page, site)
        for path in ('/', '/trends', '/alarms', '/model', '/tuning', '/audit'):
            page.goto(f'{site.url}{path}')
            page.wait_for_selector('#beat[data-beat]')
            page.locator('.q-expansion-item .q-item:visible').evaluate_all(
                'groups => groups.forEach(group => group.click())')
            expect(page.locator('header')).to_contain_text(TEXTS[4])
            for chart in page.locator('.nicegui-echart').all():
                chart.hover(position={'x': 300.0, 'y': 90.0})
            if path == '/model':
                page.get_by_role('button', name='Activate the new model …').click()
                expect(page.get_by_role('dialog')).to_contain_text(TEXTS[4])
                page.get_by_role('button', name='Cancel').last.click()
                page.get_by_role('button', name='Train').click()
                expect(page.get_by_text(f'rejected: {TEXTS[0]}').first).to_be_visible()
            assert page.evaluate('window.CAUGHT') is None, path
        browser.forgive()


def test_a_page_without_connection_whose_session_ends_asks_to_log_in(
        site: Site, browser: Pages) -> None:
    with browser.page('about:blank') as page:
        log_in(page, site)
        # its connection reaches the panel only after the session has ended
        ended = threading.Event()
        waiting: list[WebSocketRoute] = []

        def route(attempt: WebSocketRoute) -> None:
            if ended.is_set():
                attempt.connect_to_server()
            else:
                waiting.append(attempt)

        page.route_web_socket('**', route)
        # a clock that is set back between two looks
        page.add_init_script('let now = 1e12; Date.now = () => now -= 3.6e6;')
        page.goto(f'{site.url}/tuning')
        expect(page.locator('#lost')).to_contain_text(
            f'no message from the panel since {clock(NOW + 2.0)}.', timeout=PATIENCE)
        # no control would act later, when the panel is back
        expect(page.locator('#app')).to_have_attribute('inert', '')
        assert page.request.get(f'{site.url}/session').status == 204
        assert page.request.get(f'{site.url}/logout').ok
        ended.set()
        waiting[0].connect_to_server()
        page.wait_for_url(f'{site.url}/login?page=/tuning')
        browser.forgive()


def test_a_page_goes_on_when_the_clock_of_the_panel_is_set_back(
        site: Site, browser: Pages, monkeypatch: pytest.MonkeyPatch) -> None:
    with browser.page('about:blank') as page:
        log_in(page, site)
        def set_back() -> None:
            monkeypatch.setattr(site.source, 'snapshot', replace(
                site.source.snapshot, wall=NOW - 3600.0))
            page.wait_for_timeout(500.0)

        back = f'wall time {clock(NOW - 3600.0)}'
        # one snapshot could come within a second of the time that is shown, and be the last
        repeat_until(lambda: page.locator('#beat').inner_text() == back, set_back)


DATA = """() => {
    const chart = document.querySelector('.nicegui-echart');
    return getElement(parseInt(chart.id.slice(1))).chart.getOption().series[0].data;
}"""
ZOOM = """() => {
    const chart = document.querySelector('.nicegui-echart');
    getElement(parseInt(chart.id.slice(1))).chart.dispatchAction(
        {type: 'dataZoom', start: 40, end: 60});
}"""


def test_an_hour_is_drawn_with_its_extremes_and_finely_where_it_is_zoomed(
        site: Site, browser: Pages, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trend_chart, '_BUCKETS', 20)
    for k in range(36_000):
        site.source.view.trends.add('level', NOW + 0.1 * k, {
            12_345: 70.0, 23_456: -30.0}.get(k, math.sin(0.01 * k)))
    with browser.page('about:blank') as page:
        log_in(page, site)
        page.goto(f'{site.url}/trends')
        page.wait_for_selector('#beat[data-beat]')
        page.get_by_role('button', name='1 h', exact=True).click()

        def drawn(share: float) -> list[float]:
            return [value for time, value in page.evaluate(DATA)
                    if abs(time / 1e3 - NOW - 1800.0) < 1800.0 * share]

        # the middle of the hour is not in the last ten minutes, which are drawn at first
        until(lambda: drawn(0.2) and len(drawn(1.0)) > 50)
        whole = drawn(1.0)
        assert len(whole) < 100
        assert (max(whole), min(whole)) == (70.0, -30.0)
        assert len(drawn(0.2)) < 20
        page.evaluate(ZOOM)
        until(lambda: len(drawn(0.2)) > 30)
        page.get_by_label('Until, h:mm:ss').fill('12 o’clock')
        expect(page.get_by_text('not h:mm:ss or h:mm')).to_be_visible()
        page.get_by_label('Until, h:mm:ss').fill('12:00')
        expect(page.get_by_text('not h:mm:ss or h:mm')).to_have_count(0)
        browser.forgive()


WIDTHS = """() => {
    const chart = document.querySelector('.nicegui-echart');
    const grids = getElement(parseInt(chart.id.slice(1))).chart.getModel().queryComponents(
        {mainType: 'grid'});
    return grids.map(grid => grid.coordinateSystem.getRect().width);
}"""


def test_long_names_and_numbers_fit_a_narrow_window(
        site: Site, browser: Pages, monkeypatch: pytest.MonkeyPatch) -> None:
    now = site.source.snapshot
    monkeypatch.setattr(site.source, 'snapshot', replace(now, states=tuple(
        replace(face, measured=-1.23e14) for face in now.states)))
    with browser.page('about:blank') as page:
        page.set_viewport_size({'width': 375, 'height': 800})
        log_in(page, site)
        expect(page.locator('.big').first).to_contain_text('-123000000000000')
        assert page.evaluate('document.querySelector(".page").scrollWidth') <= 375
        until(lambda: len(page.evaluate(WIDTHS)) == 3)
        assert len(set(page.evaluate(WIDTHS))) == 1
        browser.forgive()


LAST_TIME = """() => {
    const chart = document.querySelector('.nicegui-echart');
    const axis = getElement(parseInt(chart.id.slice(1))).chart.getOption().xAxis[0];
    return axis.max && axis.axisLabel.formatter(axis.max);
}"""


def test_wall_times_of_a_chart_are_those_of_the_panel(
        site: Site, browser: Pages, monkeypatch: pytest.MonkeyPatch) -> None:
    with browser.page('about:blank') as page, monkeypatch.context() as changed:
        changed.setenv('TZ', 'elsewhere-5:30')
        time.tzset()
        log_in(page, site)
        latest = site.source.view.trends.latest
        assert latest is not None
        until(lambda: page.evaluate(LAST_TIME) == clock(latest))
        browser.forgive()
    time.tzset()


@pytest.mark.parametrize(('event', 'window'), [
    ({'start': 25.0, 'end': 50}, (0.25, 0.5)), ({'batch': [{'start': 0, 'end': 100}]}, (0.0, 1.0)),
    ({'start': 50.0, 'end': 25.0}, None), ({'start': -1, 'end': 5}, None), ({}, None),
    ({'start': 'nan', 'end': 5}, None), ({'batch': 1}, None), (None, None), ([], None)])
def test_the_zoom_of_a_browser_is_checked(
        event: object, window: tuple[float, float] | None) -> None:
    assert zoomed(event) == window


@pytest.mark.parametrize(('values', 'ends'), [
    ([], None), ([math.nan], None), ([0.0, 3.0], None),
    # noise of a tenth of a degree does not fill the chart of a range of twenty
    ([46.03, 46.1, math.nan], (45.0, 47.2))])
def test_an_axis_shows_a_share_of_the_range_of_its_signals(
        values: list[float], ends: tuple[float, float] | None) -> None:
    shown = axis_ends([(30.0, 40.0), (35.0, 50.0)], [np.array(values), np.array([])])
    if ends is None:
        assert shown == {'min': None, 'max': None}
        return
    low, high = shown['min'], shown['max']
    assert low is not None
    assert high is not None
    assert ends[0] <= low <= 46.03 < 46.1 <= high <= ends[1]
    assert high - low >= 2.0
    assert axis_ends([(30.0, 40.0), (35.0, 50.0)], ()) == {'min': 30.0, 'max': 50.0}


@pytest.mark.parametrize(('lengths', 'rows'), [((), 1), ((11, 21), 1), ((11, 21, 21), 2),
                                               ((27, 19), 2), ((40,) * 5, 5), ((60,), 2)])
def test_names_of_pens_have_rows_in_a_narrow_chart(lengths: tuple[int, ...], rows: int) -> None:
    assert legend_rows(['x' * length for length in lengths], 330) == rows


def test_pens_of_a_chart_have_colours_of_their_own() -> None:
    assert len({ink(number) for number in range(40)}) == 40


@pytest.mark.parametrize(('text', 'latest', 'found'), [
    ('0:03:20', 500.0, 200.0), ('1:00', 500.0, 3600.0), ('30:00:01', 500.0, 108_001.0),
    ('', 500.0, None), ('now', 500.0, None), ('1', 500.0, None)])
def test_times_are_those_of_the_plant(text: str, latest: float, found: float | None) -> None:
    assert time_of_day(text, latest) == found


def test_a_wall_time_is_the_last_before_now() -> None:
    for seconds in (NOW - 60.0, NOW - 80_000.0):
        assert time_of_day(time.strftime('%H:%M:%S', time.localtime(seconds)), NOW) == seconds
