# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the replay: its own, and those of a controller for the new model."""

from dataclasses import dataclass

from koopman_ros.parameters.controller import ControllerParameters
from koopman_ros.parameters.controller import TABLE as CONTROLLER
from koopman_ros.parameters.table import parameter, ParameterTable


@dataclass(frozen=True)
class ReplayParameters(ControllerParameters):
    """
    Snapshot of the replay's parameters.

    Those of a controller that are given replace recorded ones, for the new model alone.
    """

    model: str = parameter(
        'reactor_nz4', 'where a recorded model is looked for beside the shipped ones: a name, a '
        '.safetensors file or a folder of them')

    bags: tuple[str, ...] = parameter(
        ('run_1',), 'bags to replay, each a run of its own: .mcap files or bag folders')
    new_model: str = parameter(
        '', 'model whose commands are compared with the recorded ones, by name or path, under the '
        'recorded parameters but for those given here; empty only checks that the recorded '
        'commands are reproduced')
    output: str = parameter(
        'replay', 'folder for report.md, summary.json and the pictures; older ones in it are '
        'replaced')
    tolerance: float = parameter(
        0.1, 'difference of two commands from which on it is counted and marked', 'K', 0.0, 100.0)
    recover: bool = parameter(
        False, 'read bags that were not closed or are damaged as far as they are whole')


def _cross_check(values: ReplayParameters) -> str:
    if not values.bags or not all(values.bags):
        return f'bags = {list(values.bags)} must hold at least one path and no empty one'
    if not values.output:
        return "output = '' must name a folder, e.g. replay"
    return CONTROLLER.cross_check(values)


TABLE = ParameterTable(
    ReplayParameters, _cross_check, ReplayParameters.settings, CONTROLLER.ordered)
