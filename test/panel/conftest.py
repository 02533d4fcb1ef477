# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The one server of pages that a process can have, whose loop a module of tests chooses."""

from collections.abc import Iterator
from typing import Any

import pytest

from koopman_ros.panel.server import PanelServer
from support.browser import opened_browser, Pages
from support.users import write_users

PROXY = '127.0.0.1'


class Served:
    """
    A panel with users.

    :ivar loop: that its pages show.
    """

    loop: Any = None

    def __init__(self, users: str) -> None:
        self.server = PanelServer({'/': self}, '127.0.0.1', 0, users, '', '', [PROXY])
        self.server.start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.loop, name)


@pytest.fixture(scope='session')
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Yield the server of this process."""
    own = Served(str(write_users(tmp_path_factory.mktemp('served') / 'users')))
    yield own
    own.server.stop()


@pytest.fixture(scope='module')
def browser() -> Iterator[Pages]:
    """Yield a browser."""
    with opened_browser() as own:
        yield own
