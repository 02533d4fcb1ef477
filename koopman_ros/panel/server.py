# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The web server of the panel, in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
import logging
import secrets
import socket
import ssl
import threading
import time
from typing import Any
from urllib.parse import parse_qs
import zlib

from fastapi import FastAPI, Request
from fastapi.responses import RedirectResponse, Response
from nicegui import Client, core, ui
from starlette.middleware.sessions import SessionMiddleware
import uvicorn
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from koopman_ros.panel.access import Users
from koopman_ros.panel.alarm_page import alarm_page, alarm_strip
from koopman_ros.panel.audit_page import audit_page
from koopman_ros.panel.connections import BACKLOG, Listener, RateLimiter
from koopman_ros.panel.layout import Frame, LOOPS, PageLayout, prefix_of, Source
from koopman_ros.panel.login import AccessControl, add_login
from koopman_ros.panel.loop_page import loop_page
from koopman_ros.panel.model_page import model_page
from koopman_ros.panel.origins import is_loopback, rejection
from koopman_ros.panel.overview import overview
from koopman_ros.panel.trend_page import trend_page
from koopman_ros.panel.tuning_page import tuning_page

MAX_SOCKETS = 60  #: open pages of a user
_START = 10.0  # s until the server has started
_POLL = 0.02  # s between two looks at a server that starts
_STOP = 3.0  # s until it has ended
_LOGS = ('uvicorn.error', 'asyncio', 'nicegui', 'engineio.server', 'socketio.server')
_SOCKETS = '/_nicegui_ws/'
_PEER = 'koopman_ros.peer'  # of the connection, in the scope of a request
_HEADERS = (
    (b'x-content-type-options', b'nosniff'), (b'x-frame-options', b'DENY'),
    # without this policy, a form would have the origin null
    (b'referrer-policy', b'same-origin'), (b'cross-origin-opener-policy', b'same-origin'),
    # the templates of the pages are compiled in the browser
    (b'content-security-policy',
     b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' "
     b"'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
     b"frame-ancestors 'none'; form-action 'self'; base-uri 'self'"))
_PAGES: dict[str, Callable[[PageLayout], None]] = {
    '/': overview, '/trends': trend_page, '/alarms': alarm_page, '/model': model_page,
    '/tuning': tuning_page, '/audit': audit_page}


class _AuthMiddleware:
    """Middleware that rejects requests of other origins, and those without a login."""

    def __init__(self, app: Any, keeper: AccessControl, listener: Listener,
                 pages: Collection[str]) -> None:
        self._app, self._keeper, self._listener, self._pages = app, keeper, listener, pages

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope['type'] not in ('http', 'websocket'):
            await self._app(scope, receive, send)
            return
        kind, path = scope['type'], scope['path']
        page = kind == 'http' and path in self._pages
        session = self._keeper.session(scope, use=page)
        response = self._rejection(scope, page and scope['method'] == 'GET', session is not None)
        if response is not None and kind == 'websocket':
            await receive()
            await send({'type': 'websocket.close', 'code': 1008})
        elif response is not None:
            await response(scope, receive, _with_headers(send))
        elif session is None:
            await self._app(scope, receive, _with_headers(send))
        else:
            with self._listener.serving(scope[_PEER]):
                await self._app(scope, receive, _with_headers(send))

    def _rejection(self, scope: Any, page: bool, logged_in: bool) -> Response | None:
        headers = {name: value.decode('latin-1') for name, value in scope['headers']}
        if reason := rejection(scope['type'], headers.get(b'host', ''), headers.get(b'origin'),
                             'https' if _encrypted(scope) else 'http',
                             users=self._keeper.users is not None):
            return Response(f'rejected: {reason}\n', 403)
        if not logged_in and scope['path'] != '/login':
            query = '' if scope['path'] == '/' else f'?page={scope["path"]}'
            return RedirectResponse(f'/login{query}', 303) if page else Response(
                'log in first\n', 401)
        if scope['type'] == 'http' and scope['path'].startswith(_SOCKETS):
            # the id of a socket that polls would be a credential
            return Response('rejected: only WebSockets are served here\n', 403)
        return None


def _encrypted(scope: Any) -> bool:
    return scope['scheme'] in ('https', 'wss')


def _with_headers(send: Any) -> Any:
    async def send_with_headers(message: Any) -> None:
        if message['type'] == 'http.response.start':
            message['headers'] = [*message.get('headers', ()), *_HEADERS]
        await send(message)

    return send_with_headers


def _with_sessions(app: Any, cookie: str, age: float) -> Any:
    """Sign the cookies of sessions; over TLS they are never sent without."""
    key = secrets.token_urlsafe(32)
    plain, secure = (SessionMiddleware(app, key, cookie, int(age), same_site='strict',
                                       https_only=https_only) for https_only in (False, True))

    async def with_sessions(scope: Any, receive: Any, send: Any) -> None:
        await (secure if 'scheme' in scope and _encrypted(scope) else plain)(scope, receive, send)

    return with_sessions


def _with_peer(app: Any) -> Any:
    """Note the peer of the connection, before a proxy's header replaces it."""
    async def with_peer(scope: Any, receive: Any, send: Any) -> None:
        scope[_PEER] = scope.get('client')
        await app(scope, receive, send)

    return with_peer


class PanelServer:
    """
    The web server of a panel, one per process.

    :param loops: by namespace.
    :param users: file of users, empty for none.
    :param proxies: addresses and networks of trusted proxies, empty for none.
    :param command_timeout: s after which a press on a page is refused.
    :raises ValueError: for an address that needs users, or a wrong file.
    :raises OSError: for an address in use.
    """

    def __init__(self, loops: Mapping[str, Source], host: str, port: int, users: str,
                 certificate: str, key: str, proxies: Sequence[str] = (),
                 command_timeout: float = 5.0) -> None:
        try:
            found = Users.read(users) if users else None
        except OSError as error:
            raise ValueError(
                f'users = {users!r} cannot be read ({error.strerror}): write the file with '
                f'python -m koopman_ros.panel.access {users} NAME operator') from error
        _check(host, users, found, certificate, key, proxies)
        self._socket = _bound(host, port)
        shown = f'[{host}]' if ':' in host else host
        port = self._socket.getsockname()[1]
        self.address = f'{"https" if certificate else "http"}://{shown}:{port}'
        keeper = AccessControl(found)
        seldom = RateLimiter()
        for name in _LOGS:
            logging.getLogger(name).addFilter(seldom)
        app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        # the pages of the only one need no name of it
        sources = loops if len(loops) > 1 else dict(zip([''], loops.values(), strict=True))
        pages = {'/', *(prefix_of(loop) + path for loop in sources for path in _PAGES)}
        add_login(app, lambda: LOOPS if len(sources) > 1 else sources[''].title, pages, keeper)
        for loop, source in sources.items():
            _add_pictures(app, prefix_of(loop), source)
            for path, fill in _PAGES.items():
                _add_page(path, fill, sources, loop, keeper)
        if len(sources) > 1:
            _add_loop_page(sources, keeper)
        ui.run_with(app, title='panel', favicon='⚙', binding_refresh_interval=None,
                    show_welcome_message=False, tailwind=False, reconnect_timeout=10.0)
        app.add_middleware(_AuthMiddleware, keeper=keeper, listener=self._socket, pages=pages)
        _guard_sockets(keeper, command_timeout)
        # browsers send the cookies of a host to all its ports, and a proxy may serve several hosts
        machine = zlib.crc32(socket.gethostname().encode())
        served = _with_sessions(app, f'koopman_panel_{port}_{machine:08x}',
                                keeper.sessions.longest)
        if proxies:
            served = ProxyHeadersMiddleware(served, list(proxies))
        self._server = uvicorn.Server(uvicorn.Config(
            _with_peer(served), log_level='error', access_log=False, ws='websockets-sansio',
            lifespan='on',
            ssl_certfile=certificate or None, ssl_keyfile=key or None, server_header=False,
            timeout_graceful_shutdown=1, ws_max_size=1024 * 1024, loop='asyncio',
            proxy_headers=False, backlog=BACKLOG))
        self._thread = threading.Thread(
            target=self._server.run, args=([self._socket],), name='pages', daemon=True)

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return sum(client.has_socket_connection for client in list(Client.instances.values()))

    def start(self) -> None:
        """Start to serve; raise OSError if that fails."""
        self._thread.start()
        end = time.monotonic() + _START
        while not self._server.started and self._thread.is_alive() and time.monotonic() < end:
            time.sleep(_POLL)
        if not self._server.started:
            raise OSError(f'the web server failed, or did not start within {_START:g} s')

    def stop(self) -> None:
        """Stop to serve."""
        self._server.should_exit = True
        self._thread.join(_STOP)


def _check(host: str, file: str, users: Users | None, certificate: str, key: str,
           proxies: Sequence[str]) -> None:
    if users is not None and not len(users):
        raise ValueError(f'users = {file!r} contains no user: add one with python -m '
                         f'koopman_ros.panel.access {file} NAME operator')
    if users is None and not is_loopback(host):
        raise ValueError(
            f'host = {host!r} requires passwords: set users to a file written by python -m '
            'koopman_ros.panel.access FILE NAME ROLE, or set host to 127.0.0.1')
    if users is None and proxies:
        raise ValueError('trusted_proxy requires users, because a proxy lets other machines reach '
                         'the panel: set users')
    if certificate:
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
        except (ssl.SSLError, OSError) as error:
            raise ValueError(f'tls_certificate = {certificate!r} and tls_key = {key!r} cannot '
                             f'be used: {error}') from error


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


def _add_loop_page(sources: Mapping[str, Source], keeper: AccessControl) -> None:
    @ui.page('/')
    def build(request: Request) -> None:
        page = Frame(sources, keeper.visitor(request.scope), '/', LOOPS, [*sources.values()])
        loop_page(page)
        page.run()


def _add_page(path: str, fill: Callable[[PageLayout], None], sources: Mapping[str, Source],
              loop: str, keeper: AccessControl) -> None:
    @ui.page(prefix_of(loop) + path)
    def build(request: Request) -> None:
        page = PageLayout(sources, loop, keeper.visitor(request.scope), path)
        alarm_strip(page)
        fill(page)
        page.run()


def _add_pictures(app: FastAPI, prefix: str, source: Source) -> None:
    @app.get(f'{prefix}/picture/{{name}}', response_model=None)
    def picture(name: str) -> Response:
        # a name, no path
        found = source.learning.picture(name)
        return Response(found, 200 if found else 404, {'cache-control': 'no-store'}, 'image/png')


def _guard_sockets(keeper: AccessControl, command_timeout: float) -> None:
    """
    Let a socket act on pages of its own session: NiceGUI checks the id of a page alone.

    A press on a page carries the panel's time that the page showed. One that was on its way for
    too long is refused, and the page shows it.
    """
    sockets = core.sio

    def own(scope: Any, client_id: Any) -> bool:
        client = Client.instances.get(client_id) if isinstance(client_id, str) else None
        return (client is not None and keeper.session(scope, use=False) is not None
                and keeper.session_id(client.request.scope) == keeper.session_id(scope))

    def named(message: Any) -> Any:
        return message.get('client_id') if isinstance(message, dict) else None

    connect, handshake, disconnect = (
        sockets.handlers['/'][name] for name in ('connect', 'handshake', 'disconnect'))
    users: dict[str, str] = {}  # by socket

    def on_disconnect(sid: str) -> None:
        users.pop(sid, None)
        disconnect(sid)

    async def on_connect(sid: str, environ: dict[str, Any], *rest: Any) -> bool:
        scope = environ['asgi.scope']
        user = getattr(keeper.session(scope, use=False), 'name', '')
        if list(users.values()).count(user) >= MAX_SOCKETS:
            return False
        for client_id in parse_qs(scope['query_string'].decode('latin-1')).get('client_id', ()):
            # NiceGUI reloads a page of an earlier run of the panel
            if client_id in Client.instances and not own(scope, client_id):
                return False
        await connect(sid, environ, *rest)
        users[sid] = user
        return True

    async def on_handshake(sid: str, message: Any) -> bool:
        return own(sockets.get_environ(sid)['asgi.scope'], named(message)) and await handshake(
            sid, message)

    def guarded(handle: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
        def on_message(sid: str, message: Any) -> None:
            if own(sockets.get_environ(sid)['asgi.scope'], named(message)):
                handle(sid, message)

        return on_message

    async def on_event(sid: str, message: Any) -> None:
        if not own(sockets.get_environ(sid)['asgi.scope'], named(message)):
            return
        if isinstance(press := message.get('press'), dict):
            try:
                late = not time.monotonic() - float(press['seen']) <= command_timeout
            except (LookupError, TypeError, ValueError):
                late = True
            await sockets.emit('pressed', {'id': press.get('id'), 'late': late}, to=sid)
            if late:
                return
        sockets_handle(sid, message)

    sockets_handle = sockets.handlers['/']['event']
    sockets.on('event', on_event)
    sockets.on('connect', on_connect)
    sockets.on('handshake', on_handshake)
    sockets.on('disconnect', on_disconnect)
    for name in ('javascript_response', 'ack'):
        sockets.on(name, guarded(sockets.handlers['/'][name]))
    # browsers cannot write to the log of the panel
    sockets.on('log', lambda sid, message: None)
