# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Compiled numerics for a running controller, which goes on in numpy until they are there."""

import subprocess
import sys
import threading

from rclpy.node import Node

from koopman_ros.kernels import COMPILED, Kernels, named, PACKAGE

_PATIENCE = 2.0  # s for a compiler that is told to end


class Compiling:
    """
    Get compiled functions beside the loop, and hand them over once.

    Compiling takes half a minute where it was never done, mostly with the interpreter's lock held:
    a process of its own does that, and what it kept is loaded in a thread.
    """

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        self._found: Kernels | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self._over = False

    def begin(self) -> None:
        """Begin, unless that was done."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._load, daemon=True)
            self._thread.start()

    def _load(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'koopman_ros.compiled'], stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if self._process.wait() == 0 and not self._over:
            self._found = named(COMPILED)
        elif not self._over:
            self._log.warning(f'{PACKAGE} is not installed, or does not compile: the control step '
                              f'goes on in numpy; pip install {PACKAGE}, and try '
                              'python -m koopman_ros.compiled')

    def take(self) -> Kernels | None:
        """Return compiled functions the first time that they are there, else None."""
        found, self._found = self._found, None
        return found

    def end(self) -> None:
        """End the compiler, if it runs."""
        self._over = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        if self._thread is not None:
            self._thread.join(_PATIENCE)
