# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters for a node that ROS ignores without a message."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
import re

from koopman_ros.core.yaml_text import load_yaml


def ignored_sections(arguments: Sequence[str], program: str, full_name: str) -> list[str]:
    """
    Return a warning for each section that is for the program, but not read.

    It is one of a parameter file, or of a rule ``-p controller:name:=value``.
    ROS applies ``controller:`` only to ``/controller``, and ``/**/controller:`` only to nodes of
    that name.

    :param arguments: of the command line.
    :param program: usual name of the node, e.g. ``controller``.
    :param full_name: of the node, with its namespace, e.g. ``/east/controller``.
    """
    name = full_name.rpartition('/')[2]
    known = {f'/{program}': (program, f'/{program}'), f'/**/{program}': (f'/**/{program}',),
             f'/{name}': (name, f'/{name}')}
    unread = [section for pattern, sections in known.items() for section in sections
              if pattern not in (full_name, f'/**/{name}')]
    return [
        f'{source}: the section "{section}:" is ignored, because this node is {full_name}: use '
        f'the section "/**/{name}:" of a parameter file'
        for source, section in _sections(arguments) if section in unread]


def _sections(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each section with its source, in the order of the arguments."""
    for flag, value in pairwise(arguments):
        if flag == '--params-file':
            for section in _sections_of(value):
                yield value, section
        elif flag in ('-p', '--param') and (rule := re.match('([^:=]+):[^=]', value)):
            yield f'{flag} {value}', rule[1]


def _sections_of(file: str) -> list[str]:
    try:
        content = load_yaml(Path(file).read_text())
    except (OSError, ValueError):
        # ROS has read it, or says why not
        return []
    return [str(section) for section in content] if isinstance(content, dict) else []
