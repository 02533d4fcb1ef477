# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The report of the robustness study, in Markdown."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from koopman_ros.reports import bullets, Picture, table, write_page
from validation.robustness import attraction, narrow
from validation.robustness.loop import START
from validation.robustness.study import BANDWIDTHS, COOLANT_WEIGHTS, Found, TEMPERATURES


def write_report(found: Found, figures: Sequence[Picture], path: Path) -> None:
    """Write tables and figures."""
    write_page(path, 'How far the loop can be pushed', [
        margin_table(found), disturbance_table(found), noise_table(found),
        attraction_table(found), narrow_tables(found), '## Figures', *map(str, figures)],
        ('torch', 'numpy', 'scipy'))


def margin_table(found: Found) -> str:
    """Write the smallest margins over the range."""
    rows = []
    for weight in COOLANT_WEIGHTS:
        for bandwidth in BANDWIDTHS:
            at = [found.margins[weight, bandwidth, float(kelvin)] for kelvin in TEMPERATURES]
            rows.append((f'{weight:g}', f'{bandwidth:g}', *(
                f'{min(getattr(m, name) for m in at):.{digits}f}' for name, digits in (
                    ('gain', 0), ('phase', 0), ('delay', 1), ('distance', 2))), _apart(found, at)))
    checks = bullets(
        f'{name}: 3 % less {"grows" if below else "decays"}, 3 % more '
        f'{"grows" if above else "decays"}' for name, (below, above) in found.verified.items())
    return ('## Margins, smallest over the trained range\n\n' + table(
        ('coolant_weight', 'observer [1/min]', 'gain', 'phase [°]', 'delay [s]',
         'least distance from −1', 'delay on the lift itself differs by [s]'), rows)
        + f'\n\nIn simulation at {START:.1f} K with the default parameters:\n\n' + checks)


def _apart(found: Found, at: Sequence[Any]) -> str:
    """Tell how far the delay margins on the lift itself are from those on the true reactor."""
    keys = [key for key, m in found.margins.items() if any(m is one for one in at)]
    apart = [abs(found.margins[key].delay - found.model_margins[key].delay) for key in keys
             if found.margins[key].delay < float('inf')]
    return f'{max(apart):.2f}' if apart else '–'


def disturbance_table(found: Found) -> str:
    """Write the table of disturbances."""
    rows = [(name, _kelvin(m['largest_kelvin']), _seconds(m['seconds_to_0.2_kelvin']),
             _seconds(m['seconds_to_0.001_kelvin']), _kelvin(m['final_kelvin']),
             _kelvin(m['disturbance_kelvin']), _kelvin(m['equivalent_bias_kelvin']))
            for name, m in found.cases.items()]
    return '## Disturbances\n\n' + table(
        ('', 'largest deviation; of steps, overshoot [K]', 'to 0.2 K [s]', 'to 0.001 K [s]',
         'left at the end [K]', 'disturbance estimate [K of coolant]',
         'sensor error that would explain it [K]'), rows)


def noise_table(found: Found) -> str:
    """Write what the bandwidth costs and brings."""
    rows = [(f'{bandwidth:g}', *(f'{m[name]:.3f}' for name in (
        'coolant_kelvin', 'coolant_change_kelvin', 'temperature_kelvin')), *(
            _seconds(m[name]) for name in (
                'fouled_to_0.2_kelvin', 'fouled_to_0.001_kelvin', 'step_to_0.2_kelvin',
                'step_to_0.001_kelvin')))
            for bandwidth, m in found.noise.items()]
    return '## Noise of 0.1 K at 1 Hz\n\n' + table(
        ('observer_bandwidth [1/min]', 'coolant, st. dev. [K]', 'its change in 1 s [K]',
         'true temperature [K]', 'UA −20 %: to 0.2 K [s]', 'to 0.001 K [s]',
         '−10 K: to 0.2 K [s]', 'to 0.001 K [s]'), rows)


def attraction_table(found: Found) -> str:
    """Write the hottest starts and count the ends."""
    rows = [(f'{u:.2f}', *(f'{m[name]:.2f}' for name in (
        'physics_kelvin', 'ladder_kelvin', 'no_ladder_kelvin')))
        for u, m in found.boundaries.items()]
    counts = [(end.value, *(str(sum(one is end for one in grid.values())) for grid in (
        found.grids[True], found.grids[False], found.two_state_grid))) for end in attraction.End]
    returns = [(name, f'{margin:g}', f'{m["rest_kelvin"]:.2f}', f'{m["outside"]:.2f}',
                _seconds(m['seconds_to_0.2_kelvin']))
               for (name, margin), m in found.returns.items()]
    return (f'## Region of attraction\n\nUnder the coldest coolant the reactor heats up by itself '
            f'above {attraction.hottest_cooled():.2f} K.\n\n' + table(
                ('coolant at the start [K]', 'hottest start that any coolant saves [K]',
                 'that the loop brings back [K]', 'without fallback [K]'), rows)
            + '\n\n' + table(('of all starts', 'with fallback', 'without',
                               'two-state reactor'), counts)
            + '\n\n' + table(('back from the safe coolant', 'linear_margin', 'it rests at [K]',
                               'outside [half widths]', 'to 0.2 K [s]'), returns))


def narrow_tables(found: Found) -> str:
    """Write what became of the lifts of narrow data."""
    kinds = {'narrow': 'no fallback', 'guarded': 'fallback', 'wide': 'shipped lift, fallback'}
    rows = []
    for (name, kind), course in found.reactor.items():
        m = narrow.judge_reactor(course)
        rows.append((name, kinds[kind], _kelvin(m['hottest_kelvin']), _kelvin(m['final_kelvin']),
                     _seconds(m['seconds_to_0.2_kelvin']), 'yes' if m['ran_away'] else 'no',
                     f'{m["safe_share"]:.0%}'))
    far = [(f'{margin:g}', f'{bandwidth:g}', _kelvin(m['hottest_kelvin']),
            _kelvin(m['final_kelvin']), _seconds(m['seconds_to_0.2_kelvin']),
            'yes' if m['ran_away'] else 'no') for (margin, bandwidth), m in found.far.items()]
    others = []
    for (name, kind), course in found.two_state.items():
        m = narrow.judge_two_state(course)
        others.append((name, kinds[kind], f'{m["largest_x2"]:.1f}', f'{m["final_distance"]:.2g}',
                       'yes' if m['escaped'] else 'no', _seconds(m['left_after'])))
    return ('## Narrow data\n\n' + table(
        (f'reactor, data within ±{narrow.HALF_WIDTH:g} K', '', 'hottest [K]', 'at the end [K]',
         'to 0.2 K [s]', 'ran away', 'in safe coolant'), rows)
        + '\n\n' + table(('UA −40 %, shipped lift: linear_margin', 'observer [1/min]',
                           'hottest [K]', 'at the end [K]', 'to 0.2 K [s]', 'ran away'), far)
        + '\n\n' + table(('two-state example, box', '', 'largest x2', 'distance at the end',
                           'escaped', 'learned law left after [s]'), others))


def _kelvin(value: Any) -> str:
    if value is None:
        return '–'
    return '0' if abs(value) < 5e-4 else f'{value:.3g}' if abs(value) < 100 else f'{value:.1f}'


def _seconds(value: Any) -> str:
    return 'never' if value is None else f'{value:.3g}'
