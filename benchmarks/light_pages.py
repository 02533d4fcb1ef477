# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Pages of a panel without a browser: they load, connect and read all that is sent, but draw nothing.

To the panel they are pages like others, and the machine on which it is measured keeps its cores.
Run it as ``python -m benchmarks.light_pages ADDRESS COUNT``; it ends with its input.
"""

import asyncio
from collections.abc import Callable
import re
import sys
import urllib.parse
import urllib.request
import uuid

from websockets.asyncio.client import connect
from websockets.typing import Origin

_CLIENT = re.compile(r"'client_id': '([0-9a-f-]+)'")


async def _page(address: str, connected: Callable[[], None]) -> None:
    def load() -> str:
        with urllib.request.urlopen(address) as answer:
            return str(answer.read().decode())

    found = _CLIENT.search(await asyncio.to_thread(load))
    if found is None:
        raise RuntimeError(f'{address} is no page of a panel')
    query = urllib.parse.urlencode({
        'EIO': 4, 'transport': 'websocket', 'client_id': found[1], 'document_id': uuid.uuid4(),
        'tab_id': uuid.uuid4(), 'old_tab_id': '', 'next_message_id': 0,
        'implicit_handshake': 'true'})
    socket = f'{address.replace("http", "ws", 1)}/_nicegui_ws/socket.io/?{query}'
    async with connect(socket, origin=Origin(address), max_size=None) as page:
        async for message in page:
            # of engine.io: opened, or asked whether it is still there; of socket.io: connected
            if message[:1] == '0':
                await page.send('40')
            elif message == '2':
                await page.send('3')
            elif message[:2] == '40':
                connected()


async def _hold(address: str, count: int) -> None:
    open_pages = 0

    def connected() -> None:
        nonlocal open_pages
        open_pages += 1
        if open_pages == count:
            print('connected', flush=True)

    pages = [asyncio.create_task(_page(address, connected)) for _ in range(count)]
    ended = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
    # a page that is closed is an error
    done, _ = await asyncio.wait([*pages, ended], return_when=asyncio.FIRST_COMPLETED)
    for task in pages:
        task.cancel()
    if ended not in done:
        raise RuntimeError('a page was closed by the panel')


if __name__ == '__main__':
    asyncio.run(_hold(sys.argv[1], int(sys.argv[2])))
