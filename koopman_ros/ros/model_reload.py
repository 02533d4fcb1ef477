# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Reload of a controller's model: read and tried in a thread, activated between two samples."""

from collections.abc import Callable, Collection
import contextlib
from dataclasses import replace
import os
import threading

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from koopman_ros.core.plugins import contained
from koopman_ros.model import LiftedModel, ModelFileError
from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.parameters.model_checks import (
    load_suitable,
    LoadedModel,
    ModelCheckContext,
    reject_setpoints,
    reject_without_law,
    reject_worse,
)
from koopman_ros.parameters.signal_topics import Signals

_SHORT_WAIT = 0.2  # s that the loop may stand still for a parameter
_LONG_WAIT = 10.0  # s that the service waits for a slow disk
_MAX_READING = 8  # files that a dead disk may keep open at once


class _Trial:
    """A model file on its way, in a thread of its own that does not keep the process."""

    def __init__(self, node: Node, name: str, signals: Signals, situation: ModelCheckContext,
                 present: LiftedModel) -> None:
        self.outcome = Future()
        self.path = _absolute(name)
        self.reading = True
        self.written: int | None = None
        self.thread = threading.Thread(
            target=self._run, args=(name, signals, situation, present), daemon=True)
        self._node = node

    def _run(self, name: str, signals: Signals, situation: ModelCheckContext,
             present: LiftedModel) -> None:
        outcome: LoadedModel | str
        try:
            self.written = _written(self.path)
            outcome = load_suitable(
                name, signals, force=situation.parameters.load_rejected_model)
            reject_setpoints(outcome.model, situation)
            reject_without_law(outcome.model, situation)
            outcome = replace(outcome, comparison=reject_worse(present, outcome.model, situation))
        except (ModelFileError, FileNotFoundError) as error:
            outcome = str(error)
        except BaseException as error:
            # whatever a file may hold, or a law of one's own raises: the loop goes on as it is
            outcome = f'{name} cannot be used ({contained(error)}): train the model again'
        # before the caller can request the same file again
        self.reading = False
        self.end(outcome)

    def end(self, outcome: LoadedModel | str) -> None:
        """Return the result: the model, or why there is none."""
        self.outcome.set_result(outcome)
        executor = self._node.executor
        # in shutdown the middleware may be gone already
        with contextlib.suppress(RuntimeError):
            if executor is not None:
                executor.wake()


def _absolute(name: str) -> str:
    # the folder in which the process was started may be gone
    with contextlib.suppress(OSError):
        return os.path.abspath(os.path.expanduser(name))
    return name


def _written(path: str) -> int | None:
    """Return when a file was written, in ns; None for the name of a bundled model."""
    with contextlib.suppress(OSError):
        return os.stat(path).st_mtime_ns
    return None


class ModelReload:
    """
    Replace the model of a running controller, or keep the current one with a reason.

    Files are read and tried in a thread, so that no measurement waits for a disk. The service
    answers when that is done; a parameter must be answered at once, because only then `ros2 param
    set` can print why it was rejected. If that takes too long, the next attempt takes the result.
    A read from a disk that does not answer cannot be ended: no file is read twice at once, and few
    files together.

    :param reloaded: called in the executor when the service has activated another model.
    :param rejected: called there when a model was rejected.
    """

    def __init__(self, node: Node, in_force: LoadedModel, signals: Signals,
                 situation: Callable[[], ModelCheckContext], reloaded: Callable[[], None],
                 rejected: Callable[[], None]) -> None:
        self._signals = signals
        self.in_force, self.reloads, self.rejected = in_force, 0, ''
        self._node, self._situation = node, situation
        self._on_reloaded, self._on_rejected = reloaded, rejected
        self._accepted: LoadedModel | None = None
        self._late: _Trial | None = None  # too late for the last change of the parameter
        self._reading: list[_Trial] = []
        self._ended = False

    async def on_reload(self, _: Trigger.Request, response: Trigger.Response
                        ) -> Trigger.Response:
        """Read the file of the current model again, for the service."""
        name = self.in_force.name
        trial = self._start(name, self._situation())
        patience = threading.Timer(_LONG_WAIT, trial.end, [
            f'{name} was not read within {_LONG_WAIT:g} s: check its disk'])
        patience.daemon = True
        patience.start()
        outcome: LoadedModel | str = await trial.outcome
        patience.cancel()
        if self._ended:
            # the caller has gone
            return response
        if name != self.in_force.name:
            outcome = f'{self.in_force.name} became the current model while {name} was read'
        outcome = self._checked_again(outcome)
        if isinstance(outcome, LoadedModel):
            self._swap(outcome)
            self._on_reloaded()
            response.success, response.message = True, outcome.about
        else:
            response.success, response.message = False, self._reject(outcome)
            self._node.get_logger().error(response.message)
        return response

    def accept(self, parameters: ControllerParameters, changes: Collection[str]) -> str:
        """Return why changed parameters give no usable model, or keep the model to activate."""
        # a change of other parameters makes the result of the last trial invalid
        self._accepted, late, self._late = None, self._late, None
        if 'model' not in changes:
            return ''
        alone = set(changes) == {'model'}
        if late is not None and not (alone and late.path == _absolute(parameters.model) and (
                late.reading or late.written == _written(late.path))):
            late = None
        trial = late or self._start(parameters.model, replace(
            self._situation(), parameters=parameters))
        if not trial.outcome.done():
            trial.thread.join(_SHORT_WAIT)
        if trial.outcome.done():
            outcome = trial.outcome.result()
            if late is not None:
                outcome = self._checked_again(outcome)
        else:
            self._late = trial if alone else None
            outcome = (f'{parameters.model} is still being read after {_SHORT_WAIT:g} s: try '
                       'again, or copy it to a local disk')
        if isinstance(outcome, LoadedModel):
            self._accepted = outcome
            return ''
        return self._reject(outcome)

    def take_over(self) -> bool:
        """Activate the model that was accepted with the last change of parameters, if any."""
        accepted, self._accepted = self._accepted, None
        if accepted is not None:
            self._swap(accepted)
        return accepted is not None

    def end(self) -> None:
        """Activate no model any more, not even one that is being read."""
        self._ended = True

    @property
    def complaint(self) -> str:
        """Why the last model was rejected, or why training rejected the current one; or ''."""
        about = self.in_force.model.provenance
        return self.rejected or ('' if about.accepted is not False else (
            f'the current model {self.in_force.name} was {about.acceptance}: train it again'))

    def figures(self) -> dict[str, object]:
        """Return the diagnostics of the current model."""
        return {
            'model': self.in_force.name,
            'model file time': self.in_force.file_time,
            'model training data': self.in_force.model.provenance.data_digest[:12] or 'none',
            'model reloads': self.reloads,
            'model rejected': self.rejected or 'none',
            'model check': self.in_force.comparison or 'none',
            'model acceptance': self.in_force.model.provenance.acceptance,
        }

    def _start(self, name: str, situation: ModelCheckContext) -> _Trial:
        trial = _Trial(self._node, name, self._signals, situation, self.in_force.model)
        self._reading = [other for other in self._reading if other.reading]
        if trial.path in [other.path for other in self._reading]:
            trial.end(f'{name} is still being read: check its disk, or try again')
        elif len(self._reading) >= _MAX_READING:
            trial.end(f'{len(self._reading)} model files are still being read: check their disks')
        else:
            self._reading.append(trial)
            trial.thread.start()
        return trial

    def _checked_again(self, outcome: LoadedModel | str) -> LoadedModel | str:
        """Check the set-points, which may have changed while the file was read."""
        if isinstance(outcome, LoadedModel):
            try:
                reject_setpoints(outcome.model, self._situation())
            except ModelFileError as error:
                return str(error)
        return outcome

    def _swap(self, loaded: LoadedModel) -> None:
        self.in_force, self.rejected, self._late = loaded, '', None
        self.reloads += 1
        self._node.get_logger().info(f'{loaded.about}; {loaded.comparison}')

    def _reject(self, reason: str) -> str:
        self.rejected = f'the current model is kept: {reason}'
        self._on_rejected()
        return self.rejected
