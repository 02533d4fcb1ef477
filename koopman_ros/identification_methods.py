# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Identification methods by name, with their parameters; without torch, which the methods need."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from koopman_ros.core.declaration import NoParameters, parameter
from koopman_ros.core.plugins import plugin_class, short_name


@dataclass(frozen=True)
class WeakFormParameters:
    """Parameters of the weak form."""

    windows: tuple[float, ...] = parameter(
        (10.0, 20.0, 40.0, 80.0), 'Window lengths to try, in samples, at least 4 each.')


#: By name; one that needs a rough input matrix comes after one that estimates it.
METHODS: Mapping[str, str] = {
    'weak_form': 'koopman_ros.learning.identification:WeakForm',
    'total_variation': 'koopman_ros.learning.identification:TotalVariation'}
_PARAMETERS: Mapping[str, type[Any]] = {
    'weak_form': WeakFormParameters, 'total_variation': NoParameters}


def parameters_of(names: Sequence[str]) -> dict[str, type[Any]]:
    """
    Return the parameter dataclasses of the shipped methods, and of those that names stand for.

    :raises ValueError: for a name without a method, or a class that does not fulfil the contract.
    """
    found = dict(_PARAMETERS)
    for name in names:
        if name not in METHODS:
            # only a user's class needs the imports of the base class
            from koopman_ros.learning.identification import IdentificationMethod
            found[short_name(name)] = plugin_class(
                name, 'identification method', METHODS, IdentificationMethod).Parameters
    return found
