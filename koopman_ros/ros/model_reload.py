# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Another model in a running controller: read and tried aside, swapped between measurements."""

from collections.abc import Callable, Collection
import contextlib
from dataclasses import replace
import os
from pathlib import Path
import re
import threading

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from koopman_ros.lifting import ModelFileError
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.ros.model_loading import (
    load_suitable,
    LoadedModel,
    refuse_setpoints,
    refuse_without_law,
    Situation,
)

_SHORT_WAIT = 0.2  # s that the loop may stand still for a parameter
_LONG_WAIT = 10.0  # s that the service waits for a slow disk
_MAX_READING = 8  # files that a dead disk may keep open at once
_MOUNTS = Path('/proc/self/mountinfo')


class _Trial:
    """A model file on its way, in a thread of its own that does not keep the process."""

    def __init__(self, node: Node, name: str, situation: Situation) -> None:
        self.outcome = Future()
        self.path = _absolute(name)
        self.mount = _mount_of(self.path)
        self.reading = True
        self.thread = threading.Thread(target=self._run, args=(name, situation), daemon=True)
        self._node = node

    def _run(self, name: str, situation: Situation) -> None:
        outcome = self._tried(name, situation)
        # before whoever waits for it can ask for the same file again
        self.reading = False
        self.end(outcome)

    @staticmethod
    def _tried(name: str, situation: Situation) -> LoadedModel | str:
        try:
            loaded = load_suitable(name)
            refuse_setpoints(loaded.model, situation)
            refuse_without_law(loaded.model, situation)
        except (ModelFileError, FileNotFoundError) as error:
            return str(error)
        except Exception as error:
            # whatever a file may hold: the loop goes on with what it has
            return (f'{name} cannot be used ({type(error).__name__}: {error}): train the model '
                    'again')
        return loaded

    def end(self, outcome: LoadedModel | str) -> None:
        """Say what became of it: the model, or why there is none."""
        self.outcome.set_result(outcome)
        executor = self._node.executor
        # in shutdown the middleware may be gone already
        with contextlib.suppress(RuntimeError):
            if executor is not None:
                executor.wake()


class ModelReload:
    """
    Swap the model of a running controller, or keep the old one and say why.

    Files are read and tried in a thread, so that no measurement waits for a disk. The service
    answers when that is done, up to ten seconds later. A parameter must be answered at once, for
    only then `ros2 param set` can say why it was refused: the loop waits for the thread a fifth
    of a second, where a local file takes milliseconds. Whatever is not read by then is refused,
    and the service is there for it.

    A read from a disk that does not answer cannot be ended. No file is read twice at once, and no
    more than eight from one file system, so that little piles up and a model elsewhere is read.

    :param reloaded: called in the executor, so between two measurements, when the service has put
        another model in force.
    :param refused: called there when a model was refused.
    """

    def __init__(self, node: Node, in_force: LoadedModel, situation: Callable[[], Situation],
                 reloaded: Callable[[], None], refused: Callable[[], None]) -> None:
        self.in_force = in_force
        self.reloads = 0
        self.refused = ''
        self._node = node
        self._situation = situation
        self._on_reloaded = reloaded
        self._on_refused = refused
        self._accepted: LoadedModel | None = None
        self._reading: list[_Trial] = []

    async def on_reload(self, _: Trigger.Request, response: Trigger.Response
                        ) -> Trigger.Response:
        """Read the file of the model in force again, for the service."""
        name = self.in_force.name
        trial = self._start(name, self._situation())
        patience = threading.Timer(_LONG_WAIT, trial.end, [
            f'{name} was not read within {_LONG_WAIT:g} s: check its disk'])
        patience.daemon = True
        patience.start()
        outcome: LoadedModel | str = await trial.outcome
        patience.cancel()
        if name != self.in_force.name:
            outcome = f'the model was changed to {self.in_force.name} while {name} was read'
        if isinstance(outcome, LoadedModel):
            try:
                # the operator may have asked for another one meanwhile
                refuse_setpoints(outcome.model, self._situation())
            except ModelFileError as error:
                outcome = str(error)
        if isinstance(outcome, LoadedModel):
            self._swap(outcome)
            self._on_reloaded()
            response.success, response.message = True, outcome.about
        else:
            response.success, response.message = False, self._refuse(outcome)
            self._node.get_logger().error(response.message)
        return response

    def accept(self, parameters: ControllerParameters, changes: Collection[str]) -> str:
        """Say why a change of parameters brings no usable model, or keep it for taking over."""
        self._accepted = None
        if 'model' not in changes:
            return ''
        situation = replace(self._situation(), settings=parameters.settings())
        trial = self._start(parameters.model, situation)
        if not trial.outcome.done():
            trial.thread.join(_SHORT_WAIT)
        outcome = trial.outcome.result() if trial.outcome.done() else (
            f'{parameters.model} is still being read after {_SHORT_WAIT:g} s: try again, or copy '
            'it to a local disk')
        if isinstance(outcome, LoadedModel):
            self._accepted = outcome
            return ''
        return self._refuse(outcome)

    def take_over(self) -> bool:
        """Put the model that was accepted with the last change of parameters in force, if any."""
        accepted, self._accepted = self._accepted, None
        if accepted is not None:
            self._swap(accepted)
        return accepted is not None

    def figures(self) -> dict[str, object]:
        """Return what diagnostics show of the model in force."""
        return {
            'model': self.in_force.name,
            'model file time': self.in_force.file_time,
            'model training data': self.in_force.model.provenance.data_digest[:12] or 'none',
            'model reloads': self.reloads,
            'model refused': self.refused or 'none',
        }

    def _start(self, name: str, situation: Situation) -> _Trial:
        trial = _Trial(self._node, name, situation)
        self._reading = [other for other in self._reading if other.reading]
        beside = [other.path for other in self._reading if other.mount == trial.mount]
        if trial.path in beside:
            trial.end(f'{name} is still being read: check its disk, or try again')
        elif len(beside) >= _MAX_READING:
            trial.end(f'{len(beside)} model files of the file system {trial.mount} are still '
                      'being read: check its disk, or copy the model to another')
        else:
            self._reading.append(trial)
            trial.thread.start()
        return trial

    def _swap(self, loaded: LoadedModel) -> None:
        self.in_force, self.refused = loaded, ''
        self.reloads += 1
        self._node.get_logger().info(loaded.about)

    def _refuse(self, reason: str) -> str:
        self.refused = f'the old model is kept: {reason}'
        self._on_refused()
        return self.refused


def _absolute(name: str) -> str:
    """Return what tells one file from another, also where there is none."""
    with contextlib.suppress(OSError):
        return os.path.abspath(os.path.expanduser(name))
    # the folder in which the process was started is gone
    return name


def _mount_of(path: str) -> str:
    """Return where the file system of an absolute path is mounted; no disk is asked for that."""
    try:
        # the mount point is the fifth field, with white space and backslashes in octal
        mounts = [re.sub(r'\\([0-7]{3})', lambda code: chr(int(code[1], 8)), line.split()[4])
                  for line in _MOUNTS.read_text().splitlines()]
    except OSError:
        return '/'
    holding = [mount for mount in mounts if f'{path}/'.startswith(f'{mount.rstrip("/")}/')]
    return max(holding, key=len, default='/')
