# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Equations that a trainer fits, and their constants with ranges, as parameters give them."""

from collections.abc import Sequence
import re

_RANGE = re.compile(r'(?P<name>\w+)(\s*\[(?P<low>[^,\]]+),(?P<high>[^,\]]+)\])?')


def named_ranges(texts: Sequence[str]) -> dict[str, tuple[float, float] | None]:
    """
    Read names with ranges, as in ``friction [0.01, 0.5]``; None for a name without one.

    :raises ValueError: for a text that is none, and a name that is given twice.
    """
    found: dict[str, tuple[float, float] | None] = {}
    for text in filter(None, texts):
        match = _RANGE.fullmatch(text.strip())
        try:
            if match is None or match['name'] in found:
                raise ValueError(text)
            found[match['name']] = None if match['low'] is None else (
                float(match['low']), float(match['high']))
        except ValueError as error:
            raise ValueError(f'{text!r} must be a name, optionally with a range, e.g. friction '
                             '[0.01, 0.5], each name once') from error
    return found


def rejected(equations: str, texts: Sequence[str]) -> str:
    """
    Return why equations cannot be fitted, or an empty string.

    :param equations: name of a plant, empty for none.
    :param texts: their constants, see :func:`named_ranges`.
    """
    try:
        ranges = named_ranges(texts)
        if equations:
            # a trainer that only records does without
            from koopman_ros.plants import estimated_parameters_of, plant_class
            estimated_parameters_of(plant_class(equations), ranges)
    except ValueError as error:
        return f'physical_model = {equations!r} with estimated_constants = {list(texts)}: {error}'
    return '' if equations or not ranges else (
        f'estimated_constants names {", ".join(ranges)}, but there are no equations: set '
        'physical_model to the plant with these constants')
