# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The hands of an operator in a demo: switches, parameters, and what they lead to."""

from dataclasses import dataclass, field
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import SetBool, Trigger

from koopman_ros.demo.console import LiveTable
from koopman_ros.demo.loop import Operator


class ActError(RuntimeError):
    """A step of an act was refused, or failed."""


@dataclass
class Hands:
    """What an operator does in the course of an act; what is refused is an :class:`ActError`."""

    operator: Operator
    table: LiveTable
    phases: list[tuple[str, float]] = field(default_factory=list)  #: name and start in s

    def begin(self, name: str, text: str) -> None:
        """Begin a phase of the act, and say so."""
        self.phases.append((name, self.operator.seconds))
        self.table.announce(text)

    def switch(self, service: str, on: bool) -> None:
        """Switch what a service switches."""
        _checked(service, self.operator.harness.set_bool(service, on))

    def set(self, node: str, **values: object) -> None:
        """Set parameters of a node."""
        for result in self.operator.harness.set_parameters(node, **values):
            if not result.successful:
                raise ActError(f'{node}: {result.reason}')

    def record_anew(self, bag: Path) -> None:
        """End the recording, and begin another one."""
        self.switch('trainer/record', False)
        self.set('trainer', output=str(bag))
        self.switch('trainer/record', True)

    def wait_for(self, task: str, words: str, timeout: float) -> DiagnosticStatus:
        """Wait until a task of the trainer says so."""
        def said() -> DiagnosticStatus | None:
            status = self.operator.harness.last_status(f'trainer: {task}')
            if status is not None and status.level == DiagnosticStatus.ERROR:
                raise ActError(f'{task}: {status.message}')
            return status if status is not None and status.message.startswith(words) else None

        status = self.operator.harness.wait_until(said, f'the {task} did not end', timeout)
        assert status is not None
        return status

    def train(self, model: Path, timeout: float) -> None:
        """Let the trainer learn a model from what it records, and wait for it."""
        _checked('trainer/train', self.operator.harness.trigger('trainer/train'))
        status = self.wait_for('training', 'the new model', timeout)
        self.table.announce(status.message)
        if not model.exists():
            raise ActError(status.message)


def _checked(service: str, response: SetBool.Response | Trigger.Response) -> None:
    if not response.success:
        raise ActError(f'{service}: {response.message}')
