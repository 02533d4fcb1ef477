# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Learned linear representations of nonlinear dynamics in control of a plant, on ROS 2.

From a table to a closed loop, without ROS:

========================================  ===================================================
``read``, ``Record``                      measurements of tables and bags, as episodes
``learn``, ``TrainingResult``             a model of a record, with its dead times and verdict
``simulate``, ``FreeRun``                 a model against a record, by its inputs alone
``LiftedModel``, ``load``, ``save``       the model, and its file
``Controller``, ``State``                 the controller: a function of a state and a measurement
``Tuning``, ``InputLimits``,              its weights and limits
``SensorLimits``
``SetpointRequest``, ``at``               set-points, and their times
``run_loop``, ``LoopRun``                 a controller on a simulated plant, and its picture
``Process``, ``build``                    simulated plants
``export_c``                              the loop as C code
========================================  ===================================================

Each has an example, and settings list their fields: ``help(koopman_ros.Tuning)``.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from koopman_ros.control import Controller, SetpointRequest, State
    from koopman_ros.evaluation import at, LoopRun, run_loop
    from koopman_ros.export import export_c
    from koopman_ros.learning import FreeRun, learn, simulate, TrainingResult
    from koopman_ros.model import LiftedModel, load, save
    from koopman_ros.plants import build, Process
    from koopman_ros.records import read, Record
    from koopman_ros.tuning import InputLimits, SensorLimits, Tuning

__version__ = '0.1.0'

# Each is imported when it is first used: learning imports torch, which takes seconds.
_PACKAGES = {
    'control': ('Controller', 'SetpointRequest', 'State'),
    'evaluation': ('LoopRun', 'at', 'run_loop'),
    'export': ('export_c',),
    'learning': ('FreeRun', 'TrainingResult', 'learn', 'simulate'),
    'model': ('LiftedModel', 'load', 'save'),
    'plants': ('Process', 'build'),
    'records': ('Record', 'read'),
    'tuning': ('InputLimits', 'SensorLimits', 'Tuning')}

__all__ = ['Controller', 'FreeRun', 'InputLimits', 'LiftedModel', 'LoopRun', 'Process', 'Record',
           'SensorLimits', 'SetpointRequest', 'State', 'TrainingResult', 'Tuning', 'at', 'build',
           'export_c', 'learn', 'load', 'read', 'run_loop', 'save', 'simulate']


def __getattr__(name: str) -> Any:
    for package, names in _PACKAGES.items():
        if name in names:
            return getattr(import_module(f'koopman_ros.{package}'), name)
    raise AttributeError(f'module koopman_ros has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
