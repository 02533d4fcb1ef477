# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The pages as a server: strangers, proxies, several panels, and pages of other users."""

from collections.abc import Callable, Iterator
import contextlib
from email.message import Message
import http.client
import json
import logging
import os
from pathlib import Path
import re
import resource
import socket
import time
from typing import NamedTuple
from urllib.parse import urlencode

from nicegui import Client
from playwright.sync_api import expect
import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from koopman_ros.panel.access import Cost, hashed, Role, write_user
from koopman_ros.panel.connections import Listener, Seldom
from koopman_ros.panel.server import PanelServer
from support.browser import opened_browser
from support.hostile import HostileSource, TEXTS

# NiceGUI looks through all objects of the process for its server, also those of torch where
# another test has imported it.
pytestmark = pytest.mark.filterwarnings('ignore:.torch.distributed.reduce_op. is:FutureWarning')

PASSWORDS = {'anna': 'correct horse', 'otto': 'battery staple', 'olga': 'staple battery'}
HOST = 'panel.example'
PROXY, OTHER = '127.0.0.1', '127.0.0.9'
TIMEOUT = 30.0


class Answered(NamedTuple):
    status: int
    headers: Message
    content: str


class Site:
    """A panel with users, in a thread of this process: it can be there only once."""

    def __init__(self, folder: Path) -> None:
        users = folder / 'users'
        for name, password in PASSWORDS.items():
            role = Role.VIEWER if name == 'otto' else Role.OPERATOR
            write_user(users, name, role, hashed(password, Cost(2, 8, 1)))
        self.source = HostileSource()
        self.server = PanelServer(self.source, '127.0.0.1', 0, str(users), '', '', [PROXY])
        self.server.start()
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
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    own = Site(tmp_path_factory.mktemp('server'))
    yield own
    own.server.stop()


def forwarded(client: str, scheme: str = 'https') -> dict[str, str]:
    """Return what a proxy adds to a request."""
    return {'host': HOST, 'X_Forwarded_For': client, 'X_Forwarded_Proto': scheme,
            'Origin': f'{scheme}://{HOST}'}


# Proxies.


def test_users_log_in_through_a_proxy_with_tls(site: Site) -> None:
    answer = site.log_in('anna', source=PROXY, **forwarded('10.1.0.1'))
    assert answer.status == 303
    cookie, *rules = answer.headers['set-cookie'].split('; ')
    assert {'Secure', 'HttpOnly', 'SameSite=strict'} <= set(rules)
    answer = site.ask('GET', '/', source=PROXY, host=HOST, Cookie=cookie,
                      X_Forwarded_Proto='https')
    assert answer.status == 200
    with socketed(site, cookie, page_id(answer.content), source=PROXY, host=HOST,
                  origin=f'https://{HOST}', more={'X-Forwarded-Proto': 'https'}) as told:
        assert told is True
    # without TLS at the proxy there is no such rule for the cookie
    answer = site.log_in('anna', source=PROXY, **forwarded('10.1.0.1', 'http'))
    assert 'Secure' not in answer.headers['set-cookie']


def test_headers_of_a_proxy_are_believed_from_its_address_alone(site: Site) -> None:
    answer = site.log_in('anna', source=OTHER, **forwarded('10.1.0.2'))
    assert answer.status == 403
    assert 'trusted_proxy' in answer.content
    assert site.log_in('anna', source=PROXY, **{
        **forwarded('10.1.0.2'), 'Origin': 'https://elsewhere'}).status == 403


def test_wrong_log_ins_through_a_proxy_keep_out_their_own_address_alone(site: Site) -> None:
    def wrong(client: str) -> list[int]:
        return [site.log_in('olga', 'wrong', source=PROXY, **forwarded(client)).status
                for _ in range(6)]

    assert wrong('10.2.0.1') == [401] * 5 + [429]
    # a browser may send the header as well: what the proxy adds to it counts
    assert wrong('1.2.3.4, 10.2.0.1') == [429] * 6
    assert site.log_in('olga', source=PROXY, **forwarded('10.2.0.2')).status == 303
    assert site.log_in('olga').status == 303


def test_a_proxy_needs_users() -> None:
    with pytest.raises(ValueError, match='trusted_proxy needs users'):
        PanelServer(HostileSource(), '127.0.0.1', 0, '', '', '', [PROXY])


# Several panels.


def test_the_cookie_is_that_of_this_panel(site: Site) -> None:
    name = site.cookie('anna').partition('=')[0]
    assert re.fullmatch(rf'koopman_panel_{site.port}_[0-9a-f]{{8}}', name)
    token = site.cookie('anna').partition('=')[2]
    # the browser sends those of other panels of this host, too
    other = f'koopman_panel_{site.port + 1}_00000000=x; koopman_panel=y'
    assert site.ask('GET', '/', Cookie=f'{other}; {name}={token}').status == 200
    assert site.ask('GET', '/', Cookie=f'{other}; koopman_panel_1={token}').status == 303


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


@contextlib.contextmanager
def socketed(site: Site, cookie: str, client_id: str, *, source: str = OTHER, host: str = '',
             origin: str = '', more: dict[str, str] | None = None) -> Iterator[object]:
    """Open a socket and ask to be that of a page; give the answer."""
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
        yield json.loads(answer.removeprefix('430'))[0]


def test_the_id_of_a_page_opens_it_to_its_own_session_alone(site: Site) -> None:
    anna = site.cookie('anna')
    page = page_id(site.ask('GET', '/', Cookie=anna).content)
    for other in (site.cookie('otto'), site.cookie('olga'), site.cookie('anna')):
        with socketed(site, other, page) as told:
            assert told is False
        with opened(site, other, {
                'client_id': page, 'implicit_handshake': 'true', 'tab_id': 'tab',
                'document_id': 'document', 'next_message_id': '0'}, OTHER, '', '', {}) as own:
            assert received(own).startswith('0{')
            own.send('40')
            assert received(own).startswith('44'), 'the connection is refused'
    with socketed(site, anna, page) as told:
        assert told is True




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
        with opened(site, cookie, {}, OTHER, '', '', {}) as own:
            received(own)
            own.send('40')
            received(own)
            own.send('420' + json.dumps(['handshake', {
                'client_id': page, 'tab_id': 'tab', 'document_id': 'document',
                'next_message_id': 0}]))
            while not received(own).startswith('430'):
                pass
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
def test_requests_that_never_end_keep_nobody_out(site: Site, said: bytes) -> None:
    anna = site.cookie('anna')
    before = len(os.listdir('/proc/self/fd'))
    with contextlib.ExitStack() as stack:
        half_open(site, 400, stack, said)
        assert site.ask('GET', '/login').status == 200
        assert site.ask('GET', '/', Cookie=anna).status == 200
        # those of this test, and those of the panel
        until(lambda: len(os.listdir('/proc/self/fd')) - before <= 400 + 256)


def test_a_connection_in_use_stays_and_one_of_the_busiest_address_is_closed() -> None:
    with Listener(socket.AF_INET, socket.SOCK_STREAM, most=4) as own, \
            contextlib.ExitStack() as stack:
        own.bind(('127.0.0.1', 0))
        own.listen(8)

        def one(source: str) -> tuple[socket.socket, tuple[str, int]]:
            client = stack.enter_context(socket.create_connection(
                own.getsockname(), TIMEOUT, (source, 0)))
            accepted, address = own.accept()
            stack.enter_context(accepted)
            return client, address

        used, address = one('127.0.0.2')
        with own.serving(address):
            quiet, _ = one('127.0.0.3')
            (first, _), (second, _) = one('127.0.0.2'), one('127.0.0.2')
            one('127.0.0.4')
            assert first.recv(1) == b'', 'the oldest of the address that has most'
            for still in (used, quiet, second):
                still.settimeout(0.0)
                with pytest.raises(BlockingIOError):
                    still.recv(1)


def test_where_all_connections_are_in_use_a_new_one_is_refused() -> None:
    with Listener(socket.AF_INET, socket.SOCK_STREAM, most=1) as own:
        own.bind(('127.0.0.1', 0))
        own.listen(8)
        with socket.create_connection(own.getsockname(), TIMEOUT):
            accepted, address = own.accept()
            with accepted, own.serving(address), socket.create_connection(
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
    log.addFilter(Seldom(most=3, period=3600.0))
    for number in range(100):
        log.error('line %d', number)
    assert [record.getMessage() for record in caplog.records] == [
        'line 0', 'line 1', 'line 2 (further lines are left out for up to 3600 s)']


# All pages, in a browser.


def test_no_text_from_outside_runs_in_the_browser(site: Site) -> None:
    with opened_browser() as browser, browser.page(f'{site.url}/login') as page:
        page.get_by_label('Name').fill('anna')
        page.get_by_label('Password').fill(PASSWORDS['anna'])
        page.keyboard.press('Enter')
        page.wait_for_url(f'{site.url}/')
        for path in ('/', '/trends', '/alarms', '/model', '/tuning'):
            page.goto(f'{site.url}{path}')
            page.wait_for_selector('#beat[data-beat]')
            page.locator('.q-expansion-item .q-item:visible').evaluate_all(
                'groups => groups.forEach(group => group.click())')
            expect(page.locator('header')).to_contain_text(TEXTS[4])
            for chart in page.locator('.nicegui-echart').all():
                # what is at the cursor
                chart.hover(position={'x': 300.0, 'y': 90.0})
            if path == '/model':
                page.get_by_role('button', name='Take over the new one …').click()
                expect(page.get_by_role('dialog')).to_contain_text(TEXTS[4])
                page.get_by_role('button', name='Cancel').last.click()
                page.get_by_role('button', name='Train').click()
                expect(page.get_by_text(f'refused: {TEXTS[0]}').first).to_be_visible()
            assert page.evaluate('window.CAUGHT') is None, path
        browser.forgive()
