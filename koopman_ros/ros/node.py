# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes whose parameters are declared by a table."""

from __future__ import annotations

from collections.abc import Callable, Collection
import copy
import difflib
from functools import cached_property
import math
from typing import Any, TypeVar

from rcl_interfaces import msg
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

from koopman_ros.core.plugins import own_code
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.table import ConfigurationError, ParameterTable, Specification
from koopman_ros.ros.diagnostics import Diagnostics
from koopman_ros.ros.hosted import HostContext, HostedNode

T = TypeVar('T')

# Parameters that rclpy itself declares or reads.
_RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service')


class LoopNode(HostedNode):
    """
    A node whose parameters are those of a table, and which may complete work before its end.

    Every given value is declared, so that the table finds unknown names and rejects values with a
    clearer message than rclpy.

    :param hosting: in a process that it shares with others; alone by default.
    :ivar exit_code: ends the process, or the node in a process of many, when a node whose work is
        done sets it.
    """

    exit_code: int | None = None
    _clocks_rejected = 0

    def __init__(self, name: str, hosting: HostContext | None = None, **options: Any) -> None:
        self._followers: list[Any] = []  # callbacks by which tables are followed
        self._code: dict[str, list[str]] = {}  # module:name at the start, by parameter
        self._ranges: dict[str, msg.FloatingPointRange | msg.IntegerRange] = {}
        super().__init__(
            name, hosting, automatically_declare_parameters_from_overrides=True, **options)

    @cached_property
    def diagnostics(self) -> Diagnostics:
        """The status of the node, once a second and on change."""
        return Diagnostics(self)

    def given(self) -> dict[str, Any]:
        """Return the parameters that the node was started with, before a table is declared."""
        given: dict[str, Any] = dict(self.get_parameters_by_prefix(''))
        return {name: _as_python(parameter.value) for name, parameter in given.items()
                if parameter.value is not None}

    def complete(self) -> None:
        """Complete that work, if there is any; messages published here are sent last."""

    def create_subscription(self, msg_type: Any, topic: str, callback: Callable[[Any], None],
                            *args: Any, **options: Any) -> Subscription:
        """Subscribe as any node does; a time that cannot be does not reach its clock."""
        def on_clock(message: ClockMessage) -> None:
            clock = message.clock
            if clock.sec >= 0 and clock.nanosec < NANOSECONDS:
                callback(message)
                return
            self._clocks_rejected += 1
            self.get_logger().warning(
                f'ignored an invalid /clock message (sec {clock.sec}, nanosec {clock.nanosec}; '
                f'{self._clocks_rejected} so far): check the publisher of /clock',
                throttle_duration_sec=10.0)

        # rclpy subscribes through here for `use_sim_time`, and a negative time ends it in spin
        return super().create_subscription(
            msg_type, topic, on_clock if msg_type is ClockMessage else callback, *args, **options)

    def declare_parameters(self, namespace: str, parameters: list[Any],
                           ignore_override: bool = False) -> list[Parameter]:
        """Declare parameters, but for those given as ``[]``, at which rclpy gives up."""
        # an empty list has no type: the table asks for one that has, or it is another node's
        typed = [entry for entry in parameters if not (len(entry) > 1 and entry[1] is None)]
        return list(super().declare_parameters(namespace, typed, ignore_override))

    def describe_parameter(self, name: str) -> msg.ParameterDescriptor:
        """Return the descriptor of a parameter with its range."""
        # the one that rclpy keeps has none: rclpy would reject by it before the table does, in
        # words without the unit, and accept values beyond it by a rounding
        descriptor = copy.copy(super().describe_parameter(name))
        limits = self._ranges.get(name)
        if isinstance(limits, msg.IntegerRange):
            descriptor.integer_range = [limits]
        elif limits is not None:
            descriptor.floating_point_range = [limits]
        return descriptor

    def declare_table(self, table: ParameterTable[T], further: Collection[str] = ()) -> T:
        """
        Declare every parameter of a table, and validate the whole.

        Names that no table knows are ignored with a warning: a file may serve several nodes.

        :param further: further names that count as known.
        :raises ConfigurationError: naming the parameter, its value and the allowed range.
        """
        given: dict[str, Any] = dict(self.get_parameters_by_prefix(''))
        unknown = [name for name in given if name not in table.rows and name not in further
                   and name not in _RCLPY_PARAMETERS and not name.startswith('qos_overrides')]
        # as if they had not been given, like in any node
        for name in [*unknown, *set(given).intersection(table.rows)]:
            self.undeclare_parameter(name)
        if unknown:
            near = {name: difflib.get_close_matches(name, table.rows, n=1) for name in unknown}
            self.get_logger().warning(
                'unknown parameters are ignored: ' + ', '.join(
                    f'{name!r}' + ''.join(f' (did you mean {other}?)' for other in near[name])
                    for name in unknown))
        snapshot = table.snapshot({
            name: self._declare_row(row, given[name].value if name in given else row.default)
            for name, row in table.rows.items()})
        if reason := table.check(snapshot):
            raise ConfigurationError(reason)
        self._code = {name: own_code(table.values(snapshot)[name])
                      for name, row in table.rows.items() if row.code}
        if self._code:
            self.add_on_set_parameters_callback(self._reject_other_code)
        return snapshot

    def _reject_other_code(self, changes: list[Parameter]) -> msg.SetParametersResult:
        """Reject a module:name that was not given at the start, before it is imported."""
        for change in changes:
            known = self._code.get(change.name)
            other = [] if known is None else [
                name for name in own_code(change.value or '') if name not in known]
            if other:
                reason = (f'{change.name}: {other[0]!r} is a new module:name, which can be set '
                          f'only at start-up: restart {self.get_name()} with it')
                self.get_logger().warning(f'parameter change rejected: {reason}')
                return msg.SetParametersResult(successful=False, reason=reason)
        return msg.SetParametersResult(successful=True)

    def _declare_row(self, row: Specification, given: Any) -> Any:
        unit = f' [{row.unit}]' if row.unit else ''
        default = list(row.default) if isinstance(row.default, tuple) else row.default
        try:
            declared = self.declare_parameter(row.name, default, msg.ParameterDescriptor(
                description=row.description + unit, additional_constraints=row.range_text,
                read_only=row.read_only))
        except InvalidParameterTypeException:
            raise ConfigurationError(row.type_error(given)) from None
        if declared.value is None:
            # a list without an element has no type
            raise ConfigurationError(row.type_error([]))
        if (limits := range_of(row)) is not None:
            self._ranges[row.name] = limits
        return _as_python(declared.value)

    def follow_table(self, table: ParameterTable[T], snapshot: T, apply: Callable[[T], None],
                     accept: Callable[[T, set[str]], str] = lambda *_: '') -> None:
        """
        Keep a snapshot of a table, all of which is declared, in step with the parameters.

        :param apply: called with each new snapshot, after the change took effect.
        :param accept: called before with a valid snapshot and the names of the changed parameters;
            returns why it cannot be, or an empty string.
        """
        current = snapshot

        def changed(changes: list[Parameter]) -> dict[str, Any]:
            return {change.name: _as_python(change.value) for change in changes
                    if change.name in table.rows}

        def validate(changes: list[Parameter]) -> msg.SetParametersResult:
            if not (code := self._reject_other_code(changes)).successful:
                return code
            # rclpy has rejected values of another type
            values = changed(changes)
            try:
                merged = table.amended(current, **values)
                reason = table.check(merged, current) or accept(merged, set(values))
            except ConfigurationError as error:
                reason = str(error)
            if reason:
                self.get_logger().warning(f'parameter change rejected: {reason}')
            return msg.SetParametersResult(successful=not reason, reason=reason)

        def take_over(changes: list[Parameter]) -> None:
            nonlocal current
            if values := changed(changes):
                current = table.amended(current, **values)
                apply(current)

        self.add_on_set_parameters_callback(validate)
        self.add_post_set_parameters_callback(take_over)
        self._followers.append((validate, take_over))

    def forget_tables(self) -> None:
        """Keep no snapshot in step any more."""
        while self._followers:
            validate, take_over = self._followers.pop()
            self.remove_on_set_parameters_callback(validate)
            self.remove_post_set_parameters_callback(take_over)

    def current(self, table: ParameterTable[T]) -> T:
        """Return the snapshot of a table that is declared; ConfigurationError where it is none."""
        snapshot = table.snapshot({
            name: _as_python(self.get_parameter(name).value) for name in table.rows})
        if reason := table.check(snapshot):
            raise ConfigurationError(reason)
        return snapshot


def range_of(row: Specification) -> msg.FloatingPointRange | msg.IntegerRange | None:
    """Return the range for a slider, which holds an open minimum, too; None without an end."""
    if math.isinf(row.minimum) or math.isinf(row.maximum):
        return None
    if isinstance(row.default, int):
        return msg.IntegerRange(from_value=int(row.minimum), to_value=int(row.maximum))
    return msg.FloatingPointRange(from_value=float(row.minimum), to_value=float(row.maximum))


def _as_python(value: Any) -> Any:
    """Return a parameter's value with arrays as tuples; the service hands over array.array."""
    if isinstance(value, (str, bytes, bool, int, float)) or value is None:
        return value
    return tuple(value)
