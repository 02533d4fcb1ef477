# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The fields of a stored message definition, which are all that decoding needs.

The definition parser takes minutes for constants with long names, for comments and for defaults
of some lengths: it is given none.
"""

import re

from koopman_ros.bags.errors import DamageError
from koopman_ros.bags.limits import LARGEST_DEFINITION

# The parser compares the fields of a type with one another.
_MOST_LINES = 5000
_DELIMITER = re.compile(r'={3,}|MSG:\s')
# type, name, and what follows it
_LINE = re.compile(r'(\S+)\s+([^\s=]+)\s*(=?)')


def fields_only(definition: bytes) -> bytes:
    """
    Return a concatenated ros2msg definition without comments, constants and default values.

    What is no field, constant or comment stays, for the parser to refuse. Raises DamageError for
    more than any message type needs.
    """
    if len(definition) > LARGEST_DEFINITION:
        raise DamageError(f'{len(definition)} bytes')
    lines = [kept for line in definition.decode('utf-8').splitlines() if (kept := _field(line))]
    if len(lines) > _MOST_LINES:
        raise DamageError(f'{len(lines)} fields')
    return '\n'.join(lines).encode('utf-8')


def _field(line: str) -> str:
    """Return type and name of a field, other lines as they are, '' for those not needed."""
    line = line.partition('#')[0].strip()
    if _DELIMITER.match(line):
        return line
    found = _LINE.match(line)
    if found is None:
        return line
    return '' if found[3] else f'{found[1]} {found[2]}'
