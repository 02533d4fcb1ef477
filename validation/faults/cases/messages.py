# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of the line: messages lost, doubled, overtaken and late."""

from __future__ import annotations

from collections.abc import Callable

from validation.faults.alterations import Alteration, delayed, lost, swapped, twice, unchanged
from validation.faults.case import Case
from validation.faults.cases.sensor import altered
from validation.faults.rig import Rig

GROUP = 'messages'
SECONDS = 120.0


def _commands(make: Callable[[], Alteration]) -> Callable[[Rig], None]:
    def play(rig: Rig) -> None:
        rig.begin()
        rig.line.commands = make()
        rig.operator.ask(44.0)
        rig.run_for(SECONDS)
        rig.line.commands = unchanged
        rig.end()

    return play


def altered_in_a_step(make: Callable[[], Alteration], seconds: float) -> Callable[[Rig], None]:
    """Return the play that alters measurements while there is something to control."""
    def play(rig: Rig) -> None:
        rig.operator.ask(44.0)
        altered(make, seconds)(rig)

    return play


_ALTERATIONS: dict[str, tuple[str, Callable[[], Alteration]]] = {
    'lost': ('30 % lost', lambda: lost(0.3)),
    'mostly-lost': ('80 % lost', lambda: lost(0.8)),
    'doubled': ('each comes twice', lambda: twice),
    'swapped': ('each two in the wrong order', swapped),
    'late': ('each 3 s late', lambda: delayed(3)),
}

CASES = (
    *(Case(f'measurements-{name}', GROUP, f'measurements: {does}, while the set-point steps, '
           f'{SECONDS:g} s', altered_in_a_step(make, SECONDS), between=True, largest_step=2.0)
      for name, (does, make) in _ALTERATIONS.items()),
    *(Case(f'commands-{name}', GROUP, f'commands: {does}, while the set-point steps, '
           f'{SECONDS:g} s', _commands(make), between=True)
      for name, (does, make) in _ALTERATIONS.items()),
)
