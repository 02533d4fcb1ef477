# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Methods that estimate a polynomial drift: their contract, and those of a list by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from koopman_ros.core.arrays import Array, short_repr
from koopman_ros.core.datasets import Episode
from koopman_ros.core.declaration import NoParameters
from koopman_ros.core.plugins import contained, plugin_class, short_name
from koopman_ros.identification_methods import METHODS
from koopman_ros.learning.identification.drift import DriftModel
from koopman_ros.model import Box


@dataclass(frozen=True)
class DriftProblem:
    """Segments of a record, and the polynomial dx/dt = f(x) + B(x) u that is to be estimated."""

    episodes: Sequence[Episode]  #: segments
    box: Box  #: in whose deviations the polynomial is written
    degree: int  #: of f
    B: Array | None = None  #: weights of the inputs as :class:`DriftModel` has them, where known
    #: likewise, an estimate of an earlier method of the list; None for the first method
    rough: Array | None = None
    input_degree: int = 0  #: of the B(x) that is to be estimated

    __repr__ = short_repr


@dataclass(frozen=True)
class DriftEstimate:
    """A drift, and the variant of the method that it is from."""

    model: DriftModel
    variant: str = ''  #: e.g. ``'40 samples'``


class IdentificationMethod(ABC):
    """
    An estimate of a drift from noisy samples.

    A custom class is named as ``module:Class`` in the parameter `identification_methods`; its own
    parameters are then ``Class.<parameter>``::

        class Finest(IdentificationMethod):
            Parameters = FinestParameters

            def estimate(self, problem):
                ...
                return [DriftEstimate(model)]

    :param parameters: of the class `Parameters`, by default its defaults.
    """

    #: a frozen dataclass of the method's own parameters, see :mod:`koopman_ros.core.declaration`
    Parameters: ClassVar[type[Any]] = NoParameters

    def __init__(self, parameters: Any = None) -> None:
        self.parameters = self.Parameters() if parameters is None else parameters

    @abstractmethod
    def estimate(self, problem: DriftProblem) -> Sequence[DriftEstimate]:
        """
        Return one estimate, or several variants of which held-out segments choose.

        :raises ValueError: for a problem that the method does not suit, such as short segments.
        """


def methods_of(names: Sequence[str], parameters: Mapping[str, Mapping[str, Any]]
               ) -> dict[str, IdentificationMethod]:
    """
    Return methods of identification by name.

    :param names: of ``METHODS``, or ``module:Class`` for one of your own.
    :param parameters: fields of its `Parameters` by the name of the method.
    :raises ValueError: for a name without a method, a class that does not fulfil the contract, or
        parameters that it does not have.
    """
    found: dict[str, IdentificationMethod] = {}
    for name in names:
        kind = plugin_class(name, 'identification method', METHODS, IdentificationMethod)
        short = short_name(name)
        try:
            found[short] = kind(kind.Parameters(**parameters.get(short, {})))
        except Exception as error:
            raise ValueError(f'the identification method {name!r} cannot be configured: '
                             f'{contained(error)}') from error
    return found
