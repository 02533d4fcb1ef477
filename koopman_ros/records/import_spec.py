# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The signals to import from bags, and the account of an import."""

from collections import Counter
from dataclasses import dataclass, field

from koopman_ros.core.message_fields import MessageField


@dataclass(frozen=True)
class RecordedState:
    """A measured state in bags."""

    name: str  #: of the signal
    unit: str  #: in the episodes
    place: MessageField  #: where its measurements are


@dataclass(frozen=True)
class RecordedInput:
    """An input in bags."""

    name: str  #: of the signal
    unit: str  #: in the episodes
    command: MessageField | None  #: where it is commanded, if it is
    measured: MessageField | None = None  #: where it is measured behind its actuator, if it is
    delay: float = 0.0  #: dead time of the actuator, after which a command begins to act, in s


@dataclass
class ImportReport:
    """The result of an import in numbers and notes."""

    measurements: int = 0  #: number of values read, of all states
    used: int = 0  #: number of those in an episode
    dropped: Counter[str] = field(default_factory=Counter)  #: values left out, by reason
    spikes: Counter[str] = field(default_factory=Counter)  #: those that are spikes, by state
    checked: Counter[str] = field(default_factory=Counter)  #: values searched for spikes, by state
    notes: list[str] = field(default_factory=list)  #: anything else, in sentences

    def note(self, text: str) -> None:
        """Add a note, once."""
        if text not in self.notes:
            self.notes.append(text)

    def add(self, other: 'ImportReport') -> None:
        """Take in that of other bags."""
        self.measurements += other.measurements
        self.used += other.used
        self.dropped += other.dropped
        self.spikes += other.spikes
        self.checked += other.checked
        self.notes += other.notes

    def warnings(self, most: float = 0.02) -> list[str]:
        """Return a warning for each state with more than a share of spikes."""
        return [f'{count} of {self.checked[name]} values of {name} are spikes, which were left '
                'out: check the sensor and its wiring, or filter the record'
                for name, count in self.spikes.items() if count > most * self.checked[name]]

    def lines(self) -> list[str]:
        """Return the account in words."""
        return [f'{self.used} of {self.measurements} values used',
                *(f'{count} dropped: {why}' for why, count in sorted(self.dropped.items())
                  if count), *self.notes, *(f'warning: {one}' for one in self.warnings())]


def places_of(signal: RecordedState | RecordedInput) -> list[MessageField]:
    """Return the places of a signal."""
    if isinstance(signal, RecordedState):
        return [signal.place]
    return [found for found in (signal.command, signal.measured) if found is not None]
