# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sections of parameter files that ROS ignores without a message."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from koopman_ros.core.yaml_text import load_yaml


def ignored_sections(arguments: Sequence[str], program: str, full_name: str) -> list[str]:
    """
    Return a warning for each section of a parameter file that is for the program, but not read.

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
        f'{file}: the parameters of the section "{section}:" are ignored, because this node is '
        f'{full_name}: name the section "/**/{name}:"'
        for flag, file in pairwise(arguments) if flag == '--params-file'
        for section in _sections(file) if section in unread]


def _sections(file: str) -> list[str]:
    try:
        content = load_yaml(Path(file).read_text())
    except (OSError, ValueError):
        # ROS has read it, or says why not
        return []
    return [str(section) for section in content] if isinstance(content, dict) else []
