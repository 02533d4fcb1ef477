# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Log-in and log-out: the visitor of a request, and the log-in page."""

import asyncio
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from html import escape
from importlib.resources import files
import math
from string import Template
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.requests import ClientDisconnect

from koopman_ros.panel.access import Users
from koopman_ros.panel.layout import Visitor
from koopman_ros.panel.requests import Role
from koopman_ros.panel.sessions import Session, Sessions, Throttle

_LONGEST_FORM = 8192  # bytes
_FORM_TIMEOUT = 10.0  # s
_ID = 'id'  # of the session, in its cookie
_PAGE = Template((files(__package__) / 'login.html').read_text())


class AccessControl:
    """
    Visitors of the panel by the session of their requests.

    :param users: None if everybody who reaches the panel is the operator.
    """

    def __init__(self, users: Users | None) -> None:
        self.users = users
        self.sessions, self.throttle = Sessions(), Throttle()

    @staticmethod
    def session_id(scope: Mapping[str, Any]) -> object:
        """Return the id of the session of a request, None without one."""
        return scope['session'].get(_ID)

    def session(self, scope: Mapping[str, Any], *, use: bool = True) -> Session | None:
        """Return the session of a request, None if no user is logged in."""
        if self.users is None:
            return Session('operator', Role.ENGINEER)
        return self.sessions.find(self.session_id(scope), use=use)

    def visitor(self, scope: Mapping[str, Any]) -> Visitor:
        """Return the visitor of a page."""
        session = self.session(scope)

        def role() -> Role:
            found = self.session(scope)
            return found.role if found else Role.VIEWER

        return Visitor(session.name if session else 'nobody', role,
                       lambda: self.session(scope, use=False) is not None, self.users is not None)


def add_login(app: FastAPI, title: Callable[[], str], pages: Collection[str],
              keeper: AccessControl) -> None:
    """
    Serve the pages by which users log in and out.

    :param title: of the panel.
    :param pages: paths to which a user may return.
    """
    def login_form(page: str, message: str = '', status: int = 200) -> HTMLResponse:
        shown = f'<p role="alert">{escape(message)}</p>' if message else ''
        return HTMLResponse(_PAGE.substitute(
            title=escape(title()), message=shown,
            query=f'?page={page}' if page in pages else ''), status, {'cache-control': 'no-store'})

    # one log-in at a time takes the memory of argon2, and no thread of the pages
    verifier = ThreadPoolExecutor(1, 'log-in')

    @app.get('/login', response_model=None)
    async def login_page(page: str = '/') -> Response:
        return RedirectResponse('/', 303) if keeper.users is None else login_form(page)

    @app.post('/login', response_model=None)
    async def log_in(request: Request, page: str = '/') -> Response:
        form = partial(login_form, page)
        if keeper.users is None:
            return RedirectResponse('/', 303)
        if int(request.headers.get('content-length', _LONGEST_FORM + 1)) > _LONGEST_FORM:
            return form('name and password are too long', 413)
        try:
            given = await asyncio.wait_for(request.form(max_fields=4, max_files=0), _FORM_TIMEOUT)
        except TimeoutError:
            return form(f'no name and password within {_FORM_TIMEOUT:g} s', 408)
        except ClientDisconnect:
            return form('the connection was closed', 400)
        name, password = str(given.get('name', '')), str(given.get('password', ''))
        address = request.client.host if request.client else ''
        if wait := keeper.throttle.attempt(address, name):
            return form(f'too many attempts: try again in {math.ceil(wait)} s', 429)
        role = await asyncio.get_running_loop().run_in_executor(
            verifier, keeper.users.verify, name, password)
        if role is None:
            return form('name or password is wrong', 401)
        keeper.throttle.succeeded(address, name)
        request.session[_ID] = keeper.sessions.open(name, role)
        return RedirectResponse(page if page in pages else '/', 303)

    @app.get('/session', status_code=204)
    async def session() -> None:
        """Respond to a user who is logged in; to others, no address but that to log in does."""

    @app.get('/logout', response_model=None)
    async def log_out(request: Request) -> Response:
        keeper.sessions.close(keeper.session_id(request.scope))
        request.session.clear()
        return RedirectResponse('/login', 303)
