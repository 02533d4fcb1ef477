# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The exported C code of a demo's controller, which answers the same measurements."""

from collections.abc import Mapping
import os
from pathlib import Path
import shutil
import subprocess

import numpy as np

from koopman_ros.control import Controller
from koopman_ros.core.arrays import Array
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.demo.loop import Row
from koopman_ros.export import c_code, compiled
from koopman_ros.export.vectors import Call


class ExportedLoop:
    """
    The compiled code as a process: a row of measurements in, a row of commands out.

    :param setpoints: of the controlled states, from `step_time` in s on.
    :raises ValueError: without a C compiler.
    """

    def __init__(self, controller: Controller, sample_period: float, folder: Path,
                 setpoints: Mapping[str, float], step_time: float) -> None:
        compiler = os.environ.get('CC', 'cc')
        if shutil.which(compiler) is None:
            raise ValueError(f'the C compiler {compiler} is not installed: install gcc, or set CC')
        program = compiled(c_code(controller, sample_period), folder, compiler,
                           ('-std=c99', '-O2'))
        self._controller, self._step_time = controller, step_time
        self._setpoint = np.array([setpoints[name] for name in controller.controlled.names])
        self._process = subprocess.Popen([program], stdin=subprocess.PIPE,
                                         stdout=subprocess.PIPE, text=True)
        self._last = 0.0
        self.seconds: list[float] = []  #: of the commands, since the first measurement
        self.commands: list[Array] = []  #: (n_u,) each, in input units
        self._differences: list[Array] = []

    def answer(self, row: Row) -> None:
        """Command for the measurement of a row."""
        controller, inputs = self._controller, self._controller.model.inputs.names
        none = np.full(len(inputs), np.nan)
        call = Call(
            round((row.seconds - self._last) * NANOSECONDS),
            np.array([row.measured[name] for name in controller.measured.names]),
            self._setpoint if row.seconds >= self._step_time else np.full_like(
                self._setpoint, np.nan), none,
            np.full(len(controller.model.disturbances), np.nan))
        self._last = row.seconds
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(','.join(call.row(controller)), file=self._process.stdin, flush=True)
        command = np.array(self._process.stdout.readline().split(',')[:len(inputs)], dtype=float)
        self.seconds.append(row.seconds)
        self.commands.append(command)
        self._differences.append(np.abs(command - [row.commanded[name] for name in inputs]))

    def close(self) -> dict[str, float]:
        """End the process; return the largest difference of each input from the controller's."""
        self._process.communicate()
        return self.largest()

    def largest(self) -> dict[str, float]:
        """Return the largest difference of each input from the controller's, in its unit."""
        return dict(zip(self._controller.model.inputs.names, np.max(
            self._differences, axis=0).tolist(), strict=True))
