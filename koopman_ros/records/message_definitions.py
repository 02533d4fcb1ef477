# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Message definitions of the installed ROS 2 packages, which rosbag2 stores with each topic."""

from dataclasses import dataclass
import json
import os
from pathlib import Path
import re
import sys

_TYPE_NAME = re.compile(r'([a-zA-Z][a-zA-Z0-9_]*)/(?:msg/)?([A-Z][a-zA-Z0-9]*)')
# The type at the start of a field line, with or without an array suffix. A bounded string
# ('string<=10') does not match, and is a primitive anyway.
_FIELD_TYPE = re.compile(r'^\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+', re.MULTILINE)
_PRIMITIVES = frozenset((
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32',
    'uint32', 'int64', 'uint64', 'string', 'wstring',
))
_DELIMITER = '\n' + '=' * 80 + '\nMSG: {name}\n'


class MessageDefinitionError(LookupError):
    """A message type whose name is malformed or whose definition is not installed."""


@dataclass(frozen=True)
class MessageDefinition:
    """A message type as a reader without ROS needs it."""

    type_name: str  #: full name, e.g. ``sensor_msgs/msg/Temperature``
    text: str  #: the definition followed by those of all its fields (encoding ``ros2msg``)
    type_hash: str  #: of REP 2016, ``RIHS01_`` and 64 hexadecimal digits


def message_definition(type_name: str) -> MessageDefinition:
    """
    Look up an installed message type such as 'sensor_msgs/msg/Temperature'.

    It is searched in the prefixes of `AMENT_PREFIX_PATH`, then in `sys.prefix`. The text has the
    layout of rosbag2's LocalMessageDefinitionSource: dependencies depth first, each once, in
    alphabetical order per definition.

    Raises MessageDefinitionError for a malformed name, and where a definition or its type
    description is not installed.
    """
    package, name = _split(type_name)
    if type_name != f'{package}/msg/{name}':
        raise MessageDefinitionError(
            f'message type {type_name!r} is not a full name: write {package}/msg/{name}')
    text = _read(package, f'{name}.msg', type_name)
    description = json.loads(_read(package, f'{name}.json', type_name))
    for entry in description.get('type_hashes', ()):
        if entry['type_name'] == type_name:
            return MessageDefinition(type_name, text + _dependencies(text, package, set()),
                                     entry['hash_string'])
    raise MessageDefinitionError(
        f'the type description {name}.json of {package} carries no hash of {type_name}: '
        f'reinstall the package {_debian(package)}')


def _dependencies(text: str, package: str, seen: set[str]) -> str:
    """Return the delimited definitions of all field types of `text` that are not in `seen`."""
    parts = []
    for kind in sorted(kind if '/' in kind else f'{package}/{kind}'
                       for kind in {*_FIELD_TYPE.findall(text)} - _PRIMITIVES):
        if kind in seen:
            continue
        seen.add(kind)
        inner_package, name = _split(kind)
        inner = _read(inner_package, f'{name}.msg', kind)
        parts += [_DELIMITER.format(name=kind), inner, _dependencies(inner, inner_package, seen)]
    return ''.join(parts)


def _split(type_name: str) -> tuple[str, str]:
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise MessageDefinitionError(
            f'message type {type_name!r} is not of the form package/msg/Name, e.g. '
            'sensor_msgs/msg/Temperature')
    return match[1], match[2]


def _read(package: str, file_name: str, type_name: str) -> str:
    """Return a file of a package's share/<package>/msg from the first prefix that contains it."""
    listed = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    searched = [Path(prefix) / 'share' / package / 'msg'
                for prefix in dict.fromkeys((*listed, sys.prefix)) if prefix]
    for folder in searched:
        file = folder / file_name
        if file.is_file():
            # Bytes, to keep the line ends of the installed file.
            return file.read_bytes().decode('utf-8')
    places = ', '.join(map(str, searched))
    raise MessageDefinitionError(
        f'message type {type_name!r}: no {file_name} in {places}; install {_debian(package)}, or '
        f'source the workspace that provides {package}')


def _debian(package: str) -> str:
    return f'ros-jazzy-{package.replace("_", "-")}'
