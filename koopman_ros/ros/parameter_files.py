# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The shipped parameter files, written from the parameter tables, and the SROS2 policy.

Run it as ``python -m koopman_ros.ros.parameter_files`` after a change to a table.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from koopman_ros.parameters import controller, plant, player, replay, trainer
from koopman_ros.parameters.table import ParameterTable
from koopman_ros.ros import access

TABLES: dict[str, ParameterTable] = {
    'plant': plant.TABLE,
    'controller': controller.TABLE,
    'trainer': trainer.TABLE,
    'player': player.TABLE,
    'replay': replay.TABLE,
}


def parameter_file(node: str) -> str:
    """Return the text of a node's parameter file, every parameter at its default."""
    title = (f'# Parameters of the {node} node, all at their defaults. Use a copy with\n'
             f'#   ros2 run koopman_ros {node} --ros-args --params-file {node}.yaml\n')
    return title + TABLES[node].yaml()


def main(args: list[str] | None = None) -> int:
    """Write all parameter files and the policy."""
    parser = argparse.ArgumentParser(
        description='Write the shipped parameter files and the SROS2 policy.')
    parser.add_argument('--output', type=Path, default=Path('config'))
    output = parser.parse_args(args).output
    for node in TABLES:
        (output / f'{node}.yaml').write_text(parameter_file(node))
    (output / access.POLICY_FILE).write_text(access.policy())
    return 0


if __name__ == '__main__':
    sys.exit(main())
