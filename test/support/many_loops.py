# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A panel of many loops in a process of its own, until its standard input ends."""

import select
import sys
from typing import Any

from koopman_ros.panel.server import PanelServer
from koopman_ros.panel.snapshot import ERROR, PLANT
from support.operated import OperatedLoop

NAMES = [f'/line_{1 + at // 10}/reactor_{1 + at % 10}' for at in range(40)]
#: of which one has an alarm, and one has no plant
ALARMED, LOST = NAMES[11], NAMES[12]


class _Source:
    """A loop with a snapshot that is replaced now and then, as that of a node."""

    def __init__(self, loop: OperatedLoop) -> None:
        self.loop, self.snapshot = loop, loop.snapshot

    def __getattr__(self, name: str) -> Any:
        return getattr(self.loop, name)


def main() -> None:
    """Serve the pages."""
    loops = {name: OperatedLoop(name.strip('/')) for name in NAMES}
    loops[ALARMED].status('pump: motor', ERROR, 'motor tripped')
    loops[LOST].silent.add(PLANT)
    sources = {name: _Source(loop) for name, loop in loops.items()}
    server = PanelServer(sources, '127.0.0.1', 0, '', '', '')
    server.start()
    print(f'the panel is at {server.address}', flush=True)
    while not select.select([sys.stdin], [], [], 0.2)[0]:
        for at, source in enumerate(sources.values()):
            source.loop.measured = 47.0 + at / 10.0
            source.snapshot = source.loop.snapshot
    server.stop()


if __name__ == '__main__':
    main()
