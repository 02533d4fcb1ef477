# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The table of all methods on all records."""

from collections.abc import Mapping
from typing import Any

from koopman_ros.core.plots import table
from studies.records.baselines import BASELINES
from studies.records.sets import SETS
from studies.report import median, present, share

OWN = 'koopman_ros'


def table_of(summary: Mapping[str, Any]) -> str:
    """
    Return the table: error and fit of each method by state, ours as median and worst seed.

    Below it stands the share of dead times that are found.
    """
    rows = []
    for name, one in SETS.items():
        for state in one.states if name in summary else ():
            label, _, unit = state.partition(' ')
            rows.append((
                f'`{name}`: {label} {unit}',
                *(_cell(summary[name].get(method, {}), label) for method in (OWN, *BASELINES)),
                share(summary[name].get(OWN, {}).get('accepted'))))
    text = table(('error; fit [%]', f'{OWN} (worst seed)', *BASELINES, 'accepted'), rows)
    if 'dead_times' in summary:
        text += (f'\n\nDead times found within a sample: '
                 f'{share(summary["dead_times"]["within_a_sample"])} simulated plants.')
    return text


def _cell(found: Mapping[str, Any], label: str) -> str:
    if 'error' not in found:
        return ''
    errors, fits = found['error'][label], found['fit'][label]
    known = present(errors)
    text = f'{median(errors):.3g}; {median(fits):.1f}' if known else 'diverges'
    if len(known) < len(errors) and known:
        return f'{text} ({len(errors) - len(known)} of {len(errors)} diverge)'
    return text + (f' ({max(known):.3g}; {min(present(fits)):.1f})' if len(known) > 1 else '')
