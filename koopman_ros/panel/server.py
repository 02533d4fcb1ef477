# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Serves the pages from a thread of its own, to those who may see them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Sequence
from html import escape
from http.cookies import CookieError, SimpleCookie
import logging
import math
import socket
import ssl
import threading
from typing import Any
from urllib.parse import parse_qs
import zlib

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from nicegui import Client, core, ui
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
import uvicorn
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from koopman_ros.panel.access import (
    may_be_addressed,
    needs_password,
    Role,
    same_origin,
    Session,
    Sessions,
    Throttle,
    Users,
)
from koopman_ros.panel.alarm_page import alarm_page
from koopman_ros.panel.connections import BACKLOG, Listener, Seldom
from koopman_ros.panel.frame import Frame, Source, Visitor
from koopman_ros.panel.model_page import model_page
from koopman_ros.panel.overview import overview
from koopman_ros.panel.style import LOGIN
from koopman_ros.panel.trend_page import trend_page
from koopman_ros.panel.tuning_page import tuning_page

_START = 10.0  # s in which the server is there, and
_STOP = 3.0  # s in which it has ended
_LONGEST_FORM = 8192  # bytes
_FORM = 10.0  # s in which a form has arrived
_LOGS = ('uvicorn.error', 'asyncio', 'nicegui', 'engineio.server', 'socketio.server')
_SOCKETS = '/_nicegui_ws/'
_PEER = 'koopman_ros.peer'  # of the connection, in the scope of a request
_HEADERS = (
    (b'x-content-type-options', b'nosniff'), (b'x-frame-options', b'DENY'),
    # without any, a form would come from the origin null
    (b'referrer-policy', b'same-origin'), (b'cross-origin-opener-policy', b'same-origin'),
    # the templates of the pages are compiled in the browser
    (b'content-security-policy',
     b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' "
     b"'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
     b"frame-ancestors 'none'; form-action 'self'; base-uri 'self'"))
_PAGES: dict[str, Callable[[Frame], None]] = {
    '/': overview, '/trends': trend_page, '/alarms': alarm_page, '/model': model_page,
    '/tuning': tuning_page}


class Doorkeeper:
    """
    Who may come in: of what origin, and logged in where there are users.

    :param users: None where whoever reaches the panel is the operator.
    :param cookie: name of the one with the token of a session.
    """

    def __init__(self, users: Users | None, cookie: str) -> None:
        self.users, self.cookie = users, cookie
        self.sessions, self.throttle = Sessions(), Throttle()

    def token(self, headers: Iterable[tuple[bytes, bytes]]) -> str | None:
        """Return the token in the cookies of a request."""
        cookies = '; '.join(
            value.decode('latin-1') for name, value in headers if name == b'cookie')
        try:
            found = SimpleCookie(cookies).get(self.cookie)
        except CookieError:
            return None
        return found.value if found else None

    def refusal(self, kind: str, headers: dict[str, str], scheme: str) -> str:
        """
        Return why a request is refused whatever its session is, or ''.

        :param scheme: 'http' or 'https', which a proxy may have served.
        """
        host, origin = headers.get('host', ''), headers.get('origin')
        if not may_be_addressed(host, self.users):
            return 'this panel is not reached by that name: use 127.0.0.1'
        if (kind == 'websocket' or origin is not None) and not same_origin(origin, host, scheme):
            return 'this comes from a page of another origin' + (
                '; if a proxy serves the panel over TLS, its address must be in trusted_proxy'
                if same_origin(origin, host, 'https') else '')
        return ''

    def session(self, token: str | None, *, use: bool = True) -> Session | None:
        """Return who is logged in with a token; None where nobody is."""
        if self.users is None:
            return Session('operator', Role.OPERATOR)
        return self.sessions.find(token, use=use)

    def visitor(self, token: str | None) -> Visitor:
        """Return who looks at a page."""
        session = self.session(token)
        name = session.name if session else 'nobody'

        def may_act() -> bool:
            found = self.session(token)
            return found is not None and found.role is Role.OPERATOR

        return Visitor(name, may_act, lambda: self.session(token, use=False) is not None,
                       self.users is not None)


class _Gate:
    """Passes on the requests that a doorkeeper lets in."""

    def __init__(self, app: Any, keeper: Doorkeeper, listener: Listener) -> None:
        self._app, self._keeper, self._listener = app, keeper, listener

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope['type'] not in ('http', 'websocket'):
            await self._app(scope, receive, send)
            return
        headers = {name.decode('latin-1'): value.decode('latin-1')
                   for name, value in scope['headers']}
        kind, path = scope['type'], scope['path']
        scheme = {'ws': 'http', 'wss': 'https'}.get(scope['scheme'], scope['scheme'])
        session = self._keeper.session(self._keeper.token(scope['headers']),
                                       use=kind == 'http' and path in _PAGES)
        response: Response | None = None
        if refusal := self._keeper.refusal(kind, headers, scheme):
            response = Response(f'refused: {refusal}\n', 403)
        elif path != '/login' and session is None:
            response = RedirectResponse('/login', 303) if (
                path in _PAGES and scope.get('method') == 'GET') else Response(
                    'log in first\n', 401)
        elif kind == 'http' and path.startswith(_SOCKETS):
            # else the id of a socket would let others than who opened it send through it
            response = Response('refused: only WebSockets are served here\n', 403)
        if response is not None:
            if kind == 'websocket':
                await receive()
                await send({'type': 'websocket.close', 'code': 1008})
            else:
                await response(scope, receive, _guarded(send))
            return
        if session is None:
            await self._app(scope, receive, _guarded(send))
            return
        with self._listener.serving(scope[_PEER]):
            await self._app(scope, receive, _guarded(send))


def _guarded(send: Any) -> Any:
    async def with_headers(message: Any) -> None:
        if message['type'] == 'http.response.start':
            message['headers'] = [*message.get('headers', ()), *_HEADERS]
        await send(message)

    return with_headers


class PanelServer:
    """
    The pages of a panel, one for a process.

    :param users: file of users, empty for none.
    :param proxies: addresses and networks of the proxies before it, empty for none.
    :raises ValueError: for an address that must not be served without users, and a wrong file.
    :raises OSError: for an address that cannot be had, or files that cannot be read.
    """

    def __init__(self, source: Source, host: str, port: int, users: str, certificate: str,
                 key: str, proxies: Sequence[str] = ()) -> None:
        found = Users.read(users) if users else None
        if found is not None and not len(found):
            raise ValueError(f'users = {users!r} has no user in it: write one by '
                             f'python -m koopman_ros.panel.access {users} NAME operator')
        if reason := needs_password(host, found):
            raise ValueError(reason)
        scheme = 'https' if certificate else 'http'
        if certificate:
            try:
                ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
            except (ssl.SSLError, OSError) as error:
                raise ValueError(f'tls_certificate = {certificate!r} and tls_key = {key!r} cannot '
                                 f'be used: {error}') from error
        if proxies and found is None:
            raise ValueError('trusted_proxy needs users: a proxy lets others than those of this '
                             'machine reach the panel; name a file of users')
        self._socket = _bound(host, port)
        shown = f'[{host}]' if ':' in host else host
        port = self._socket.getsockname()[1]
        self.address = f'{scheme}://{shown}:{port}'
        # browsers send the cookies of a host to all its ports, and a proxy may serve several hosts
        machine = zlib.crc32(socket.gethostname().encode())
        self._keeper = Doorkeeper(found, f'koopman_panel_{port}_{machine:08x}')
        seldom = Seldom()
        for name in _LOGS:
            logging.getLogger(name).addFilter(seldom)
        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        _add_login(app, source, self._keeper)
        _add_pictures(app, source)
        for path, fill in _PAGES.items():
            _add_page(path, fill, source, self._keeper)
        ui.run_with(app, title='panel', favicon='⚙', binding_refresh_interval=None,
                    show_welcome_message=False, tailwind=False, reconnect_timeout=10.0)
        app.add_middleware(_Gate, keeper=self._keeper, listener=self._socket)
        _guard_sockets(self._keeper)
        served: Any = app
        if proxies:
            served = ProxyHeadersMiddleware(served, list(proxies))
        self._server = uvicorn.Server(uvicorn.Config(
            _with_peer(served), log_level='error', access_log=False, ws='websockets-sansio',
            lifespan='on',
            ssl_certfile=certificate or None, ssl_keyfile=key or None, server_header=False,
            timeout_graceful_shutdown=1, ws_max_size=1024 * 1024, loop='asyncio',
            proxy_headers=False, backlog=BACKLOG))
        self._thread = threading.Thread(target=self._serve, name='pages', daemon=True)
        self._begun = threading.Event()

    @property
    def pages(self) -> int:
        """How many pages are open."""
        return sum(client.has_socket_connection for client in list(Client.instances.values()))

    def start(self) -> None:
        """Serve from now on; raise OSError where that does not begin."""
        self._thread.start()
        if not self._begun.wait(_START):
            raise OSError(f'the pages are not served within {_START:g} s')
        if not self._server.started:
            raise OSError('the pages cannot be served')

    def stop(self) -> None:
        """Serve no more."""
        self._server.should_exit = True
        self._thread.join(_STOP)

    def _serve(self) -> None:
        started = self._server.startup

        async def startup(sockets: Any = None) -> None:
            try:
                await started(sockets)
            finally:
                self._begun.set()

        self._server.startup = startup  # type: ignore[method-assign]
        try:
            self._server.run([self._socket])
        finally:
            self._begun.set()


def _with_peer(app: Any) -> Any:
    """Note whose connection it is, before a proxy's header says for whom."""
    async def noted(scope: Any, receive: Any, send: Any) -> None:
        scope[_PEER] = scope.get('client')
        await app(scope, receive, send)

    return noted


def _guard_sockets(keeper: Doorkeeper) -> None:
    """Let a socket act on pages of its own session: NiceGUI checks the id of a page alone."""
    sockets = core.sio

    def own(scope: Any, client_id: Any) -> bool:
        client = Client.instances.get(client_id) if isinstance(client_id, str) else None
        token = keeper.token(scope['headers'])
        return (client is not None and keeper.session(token, use=False) is not None
                and keeper.token(client.request.scope['headers']) == token)

    def named(message: Any) -> Any:
        return message.get('client_id') if isinstance(message, dict) else None

    connect, handshake = (sockets.handlers['/'][name] for name in ('connect', 'handshake'))

    async def on_connect(sid: str, environ: dict[str, Any], *rest: Any) -> bool:
        scope = environ['asgi.scope']
        for client_id in parse_qs(scope['query_string'].decode('latin-1')).get('client_id', ()):
            # to one of a panel that was there before, NiceGUI answers that it loads itself again
            if client_id in Client.instances and not own(scope, client_id):
                return False
        await connect(sid, environ, *rest)
        return True

    async def on_handshake(sid: str, message: Any) -> bool:
        return own(sockets.get_environ(sid)['asgi.scope'], named(message)) and await handshake(
            sid, message)

    def guarded(handle: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
        def on_message(sid: str, message: Any) -> None:
            if own(sockets.get_environ(sid)['asgi.scope'], named(message)):
                handle(sid, message)

        return on_message

    sockets.on('connect', on_connect)
    sockets.on('handshake', on_handshake)
    for name in ('event', 'javascript_response', 'ack'):
        sockets.on(name, guarded(sockets.handlers['/'][name]))
    # no browser writes to the log of the panel
    sockets.on('log', lambda sid, message: None)


def _bound(host: str, port: int) -> Listener:
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    own = Listener(family, kind, protocol)
    try:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind(address)
        own.listen(BACKLOG)
    except OSError as error:
        own.close()
        raise OSError(f'the pages cannot be served on {host}, port {port} ({error.strerror}): '
                      'choose another port, or 0 for any') from error
    return own


def _add_page(path: str, fill: Callable[[Frame], None], source: Source, keeper: Doorkeeper
              ) -> None:
    @ui.page(path)
    def build(request: Request) -> None:
        frame = Frame(source, keeper.visitor(keeper.token(request.scope['headers'])), path)
        fill(frame)
        frame.run()


def _add_pictures(app: FastAPI, source: Source) -> None:
    @app.get('/picture/{name}', response_model=None)
    def picture(name: str) -> Response:
        # by name alone: no path comes from a browser
        found = source.learning.picture(name)
        return Response(found, 200 if found else 404, {'cache-control': 'no-store'}, 'image/png')


def _add_login(app: FastAPI, source: Source, keeper: Doorkeeper) -> None:
    def form(said: str = '', status: int = 200) -> HTMLResponse:
        about = f'<p role="alert">{escape(said)}</p>' if said else ''
        return HTMLResponse(LOGIN.format(title=escape(source.title), said=about), status,
                            {'cache-control': 'no-store'})

    @app.get('/login', response_model=None)
    def ask() -> Response:
        return RedirectResponse('/', 303) if keeper.users is None else form()

    @app.post('/login', response_model=None)
    async def log_in(request: Request) -> Response:
        users = keeper.users
        if users is None:
            return RedirectResponse('/', 303)
        if int(request.headers.get('content-length', _LONGEST_FORM + 1)) > _LONGEST_FORM:
            return form('that is too long', 413)
        try:
            given = await asyncio.wait_for(request.form(max_fields=4, max_files=0), _FORM)
        except TimeoutError:
            return form(f'no name and password within {_FORM:g} s', 408)
        except ClientDisconnect:
            return form('the form was cut off', 400)
        name, password = str(given.get('name', '')), str(given.get('password', ''))
        address = request.client.host if request.client else ''
        if wait := keeper.throttle.attempt(address, name):
            return form(f'too many attempts: try again in {math.ceil(wait)} s', 429)
        role = await run_in_threadpool(users.verify, name, password)
        if role is None:
            return form('name or password is wrong', 401)
        keeper.throttle.succeeded(address, name)
        response = RedirectResponse('/', 303)
        response.set_cookie(keeper.cookie, keeper.sessions.open(name, role), httponly=True,
                            samesite='strict', secure=request.url.scheme == 'https', path='/')
        return response

    @app.get('/logout', response_model=None)
    def log_out(request: Request) -> Response:
        keeper.sessions.close(keeper.token(request.scope['headers']))
        response = RedirectResponse('/login', 303)
        response.delete_cookie(keeper.cookie)
        return response
