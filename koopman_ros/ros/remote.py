# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Services and parameters of another node, asked without waiting."""

from collections.abc import Callable, Mapping
import math
import time
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParametersAtomically,
)
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.task import Future

from koopman_ros.panel.plant import ParameterView

_PATIENCE = 30.0  # s until an answer counts as lost
_CHOICES = 'one of '  # what the range of a choice begins with
_OWN = ('qos_overrides', 'use_sim_time', 'start_type_description_service')


class RemoteNode:
    """
    Another node of a fixed name, which may come and go.

    :param on_parameters: called with all parameters whenever they are other ones.
    """

    def __init__(self, node: Node, name: str,
                 on_parameters: Callable[[Mapping[str, ParameterView]], None]) -> None:
        self._node, self.name, self._on_parameters = node, name, on_parameters
        self._full = node.resolve_service_name(name)
        self._clients: dict[str, Client] = {}
        self._waiting: list[tuple[float, Future, Callable[[Any], None]]] = []
        self._stale, self._reading = True, False
        self._known: Mapping[str, ParameterView] = {}
        for kind, service in ((ListParameters, 'list_parameters'),
                              (DescribeParameters, 'describe_parameters'),
                              (GetParameters, 'get_parameters'),
                              (SetParametersAtomically, 'set_parameters_atomically')):
            self.offer(kind, service)

    def offer(self, kind: Any, service: str) -> None:
        """Prepare calls of a service."""
        self._clients[service] = self._node.create_client(kind, f'{self.name}/{service}')

    def call(self, service: str, request: Any, answered: Callable[[Any], None]) -> None:
        """Call a service; `answered` is given the response, or None where none comes."""
        client = self._clients[service]
        if not client.service_is_ready():
            answered(None)
            return
        future = client.call_async(request)
        self._waiting.append((time.monotonic() + _PATIENCE, future, answered))
        future.add_done_callback(self._on_answer)

    def set_parameters(self, values: Mapping[str, Any], answered: Callable[[Any], None]) -> None:
        """Set parameters, all or none."""
        self.call('set_parameters_atomically', SetParametersAtomically.Request(parameters=[
            Parameter(name, value=list(value) if isinstance(value, tuple) else value
                      ).to_parameter_msg() for name, value in values.items()]), answered)

    def on_event(self, event: ParameterEvent) -> None:
        """Take an event of parameters of any node."""
        if event.node == self._full:
            self._stale = True

    def look(self) -> None:
        """Read the parameters again where they changed; to be called once in a while."""
        now = time.monotonic()
        for entry in [one for one in self._waiting if now > one[0]]:
            self._waiting.remove(entry)
            entry[2](None)
        if not self._clients['get_parameters'].service_is_ready():
            self._stale = True
            if self._known:
                self._take({})
        elif self._stale and not self._reading:
            self._stale, self._reading = False, True
            self.call('list_parameters', ListParameters.Request(), self._on_listed)

    def _on_answer(self, future: Future) -> None:
        for entry in [one for one in self._waiting if one[1] is future]:
            self._waiting.remove(entry)
            entry[2](None if future.exception() else future.result())

    def _on_listed(self, response: Any) -> None:
        if response is None:
            self._again()
            return
        names = [name for name in response.result.names if not name.startswith(_OWN)]

        def described(descriptions: Any) -> None:
            if descriptions is None:
                self._again()
                return

            def got(values: Any) -> None:
                self._reading = False
                if values is None or len(values.values) != len(names):
                    self._stale = True
                    return
                self._take({view.name: view for view in map(
                    _view, descriptions.descriptors, values.values)})

            self.call('get_parameters', GetParameters.Request(names=names), got)

        self.call('describe_parameters', DescribeParameters.Request(names=names), described)

    def _again(self) -> None:
        self._stale, self._reading = True, False

    def _take(self, found: Mapping[str, ParameterView]) -> None:
        self._known = found
        self._on_parameters(found)


def _view(about: ParameterDescriptor, value: Any) -> ParameterView:
    meaning, unit = about.description, ''
    if meaning.endswith(']') and ' [' in meaning:
        meaning, _, unit = meaning[:-1].rpartition(' [')
    given = parameter_value_to_python(value)
    if not isinstance(given, (bool, int, float, str)) and given is not None:
        given = tuple(given)
    lower, upper = -math.inf, math.inf
    for limits in (*about.floating_point_range, *about.integer_range):
        lower, upper = float(limits.from_value), float(limits.to_value)
    words = about.additional_constraints
    return ParameterView(
        about.name, given, unit, meaning, words, lower, upper, about.read_only,
        tuple(words.removeprefix(_CHOICES).split(', ')) if words.startswith(_CHOICES) else ())
