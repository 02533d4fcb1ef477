# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A Dask scheduler and its workers, each started by its own command, on the loopback interface."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
import sys
import time
from types import TracebackType

from koopman_ros.startup import ONE_THREAD
from koopman_ros.testing.process import NodeProcess

_START = 60.0  # s until a scheduler has written where it listens
_PERIOD = 0.05  # s between two looks
_LOCAL = ('--host', '127.0.0.1')


class DaskProcesses:
    """
    `dask scheduler`, and as many `dask worker` as are started; leaving the context ends them.

    :param folder: for their logs, and the file in which the scheduler says where it listens.
    :raises TimeoutError: when the scheduler does not start.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / 'scheduler.json'
        self._stack = contextlib.ExitStack()
        self.workers: list[NodeProcess] = []
        self.scheduler = self._start('scheduler', *_LOCAL, '--port', '0', '--no-dashboard',
                                     '--no-show', '--scheduler-file', str(self._file))
        deadline = time.monotonic() + _START
        while not (address := self._written()):
            if time.monotonic() > deadline or not self.scheduler.running:
                self._stack.close()
                raise TimeoutError(f'dask scheduler did not start:\n{self.scheduler.output()}')
            time.sleep(_PERIOD)
        self.address: str = address

    def _written(self) -> str:
        """Return where the scheduler listens, empty until it has written that to the end."""
        with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):
            return str(json.loads(self._file.read_text())['address'])
        return ''

    def start_worker(self) -> NodeProcess:
        """Start one more worker, of one thread; it joins by itself."""
        self.workers.append(self._start(
            'worker', self.address, *_LOCAL, '--nthreads', '1', '--no-nanny', '--no-dashboard',
            '--local-directory', str(self._folder)))
        return self.workers[-1]

    def _start(self, kind: str, *arguments: str) -> NodeProcess:
        name = f'{kind}_{len(self.workers)}'
        paths = os.pathsep.join(filter(None, [os.getcwd(), os.environ.get('PYTHONPATH')]))
        return self._stack.enter_context(NodeProcess(
            name, {}, self._folder / f'{name}.log', {**ONE_THREAD, 'PYTHONPATH': paths},
            command=(sys.executable, '-m', 'dask', kind, *arguments)))

    def __enter__(self) -> DaskProcesses:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._stack.close()
