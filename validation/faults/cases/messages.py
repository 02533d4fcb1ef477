# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages between plant and controller that are lost, doubled, overtaken and late."""

from collections.abc import Callable

from validation.faults.alterations import Alteration, delayed, lost, swapped, twice
from validation.faults.case import case
from validation.faults.cases.sensor import altered

GROUP = 'messages'
SECONDS = 120.0

_ALTERATIONS: dict[str, tuple[str, Callable[[], Alteration]]] = {
    'lost': ('30 % lost', lambda: lost(0.3)),
    'mostly-lost': ('80 % lost', lambda: lost(0.8)),
    'doubled': ('each comes twice', lambda: twice),
    'swapped': ('each two in the wrong order', swapped),
    'late': ('each 3 s late', lambda: delayed(3)),
}

CASES = tuple(
    case(GROUP, f'{what}-{name}', f'{what}: {does}, while the set-point steps, {SECONDS:g} s',
         altered(make, SECONDS, 44.0, commands=what == 'commands'), between=True,
         largest_step=largest_step)
    for what, largest_step in (('measurements', 2.0), ('commands', 1.0))
    for name, (does, make) in _ALTERATIONS.items())
