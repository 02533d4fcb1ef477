# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A node that leaves to its parameter table what rclpy would answer less clearly itself."""

from __future__ import annotations

import copy
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter


class ParameterNode(Node):
    """
    A node whose parameters are those of a :class:`ParameterTable`.

    Every value that it was given is declared, so that the table finds names it does not know.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._ranges: dict[str, FloatingPointRange | IntegerRange] = {}
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)

    def declare_parameters(self, namespace: str, parameters: list[Any],
                           ignore_override: bool = False) -> list[Parameter]:
        """
        Declare parameters, but for those given as ``[]``, at which rclpy gives up.

        An empty list has no type: the table asks for one that has, or it belongs to another node.
        """
        typed = [entry for entry in parameters if not (len(entry) > 1 and entry[1] is None)]
        declared: list[Parameter] = super().declare_parameters(namespace, typed, ignore_override)
        return declared

    def set_range(self, name: str, limits: FloatingPointRange | IntegerRange) -> None:
        """Tell the range of a declared parameter to those who ask for its description."""
        self._ranges[name] = limits

    def describe_parameter(self, name: str) -> ParameterDescriptor:
        """
        Return the descriptor of a parameter with its range.

        The one that rclpy keeps has none: rclpy would refuse a value by it before the table does,
        in words without the unit, and let pass what exceeds it by a rounding.
        """
        descriptor = copy.copy(super().describe_parameter(name))
        limits = self._ranges.get(name)
        if isinstance(limits, IntegerRange):
            descriptor.integer_range = [limits]
        elif limits is not None:
            descriptor.floating_point_range = [limits]
        return descriptor
