# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Services and parameters of another node, called without waiting."""

from __future__ import annotations

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

from koopman_ros.parameters.description import ParameterDescription

TIMEOUT = 30.0  #: s until a response counts as lost
_CHOICES = 'one of '  # at the beginning of the range of a choice
_OF_RCLPY = ('qos_overrides', 'use_sim_time', 'start_type_description_service')


def repeated(request: Callable[[], Future], period: float) -> Callable[[], Future | None]:
    """
    Return a function to be polled: it sends a request again each period until one is answered.

    A server that does not know its client yet loses the response, so the request has to be one
    that may be repeated.

    :param period: in s.
    :return: function that returns the future with the response, None before it has come.
    """
    sent: list[Future] = []
    due = 0.0

    def response() -> Future | None:
        nonlocal due
        if (now := time.monotonic()) >= due:
            sent.append(request())
            due = now + period
        return next((future for future in sent if future.done()), None)

    return response


class RemoteNode:
    """
    Another node of a fixed name, which may come and go.

    :param services: types of the called services, in addition to those of parameters, by name.
    :param on_parameters: called with all parameters when they have changed; by default they are
        neither read nor set.
    """

    def __init__(self, node: Node, name: str, services: Mapping[str, Any],
                 on_parameters: Callable[[Mapping[str, ParameterDescription]], None] | None = None
                 ) -> None:
        self._full, self._on_parameters = node.resolve_service_name(name), on_parameters
        kinds = dict(services) if on_parameters is None else {
            'list_parameters': ListParameters, 'describe_parameters': DescribeParameters,
            'get_parameters': GetParameters,
            'set_parameters_atomically': SetParametersAtomically, **services}
        self._clients: dict[str, Client] = {
            service: node.create_client(kind, f'{name}/{service}')
            for service, kind in kinds.items()}
        self._waiting: dict[Future, tuple[float, Callable[[Any], None]]] = {}
        self._stale, self._reading = True, False
        self._known = False

    @property
    def running(self) -> bool:
        """Whether the node offers its services; it may still not respond."""
        return all(client.service_is_ready() for client in self._clients.values())

    def call(self, service: str, request: Any, on_response: Callable[[Any], None]) -> None:
        """Call a service; `on_response` is called with its response, or with None for none."""
        client = self._clients[service]
        if not client.service_is_ready():
            on_response(None)
            return
        future = client.call_async(request)
        self._waiting[future] = (time.monotonic() + TIMEOUT, on_response)
        future.add_done_callback(self._on_done)

    def set_parameters(self, values: Mapping[str, Any],
                       on_response: Callable[[Any], None]) -> None:
        """Set all of some parameters, or none."""
        self.call('set_parameters_atomically', SetParametersAtomically.Request(parameters=[
            Parameter(name, value=list(value) if isinstance(value, tuple) else value
                      ).to_parameter_msg() for name, value in values.items()]), on_response)

    def on_event(self, event: ParameterEvent) -> None:
        """Take a parameter event of any node."""
        if event.node == self._full:
            self._stale = True

    def update(self) -> None:
        """Read the parameters again if they changed; to be called periodically."""
        now = time.monotonic()
        for future in [one for one, (deadline, _) in self._waiting.items() if now > deadline]:
            self._waiting.pop(future)[1](None)
        if self._on_parameters is None:
            return
        if not self._clients['get_parameters'].service_is_ready():
            self._stale = True
            if self._known:
                self._take({})
        elif self._stale and not self._reading:
            self._stale, self._reading = False, True
            self.call('list_parameters', ListParameters.Request(), self._on_listed)

    def _on_done(self, future: Future) -> None:
        if found := self._waiting.pop(future, None):
            found[1](None if future.exception() else future.result())

    def _on_listed(self, listed: Any) -> None:
        if listed is None:
            self._read_again()
            return
        names = [name for name in listed.result.names if not name.startswith(_OF_RCLPY)]

        def on_described(described: Any) -> None:
            def on_values(response: Any) -> None:
                if described is None or response is None or len(response.values) != len(names):
                    self._read_again()
                    return
                self._reading = False
                self._take({one.name: one for one in map(
                    _description, described.descriptors, response.values)})

            self.call('get_parameters', GetParameters.Request(names=names), on_values)

        self.call('describe_parameters', DescribeParameters.Request(names=names), on_described)

    def _read_again(self) -> None:
        self._stale, self._reading = True, False

    def _take(self, found: Mapping[str, ParameterDescription]) -> None:
        self._known = bool(found)
        if self._on_parameters is not None:
            self._on_parameters(found)


def _description(about: ParameterDescriptor, value: Any) -> ParameterDescription:
    meaning, unit = about.description, ''
    if meaning.endswith(']') and ' [' in meaning:
        meaning, _, unit = meaning[:-1].rpartition(' [')
    found = parameter_value_to_python(value)
    if not isinstance(found, (bool, int, float, str)) and found is not None:
        found = tuple(found)
    lower, upper = -math.inf, math.inf
    for limits in (*about.floating_point_range, *about.integer_range):
        lower, upper = float(limits.from_value), float(limits.to_value)
    words = about.additional_constraints
    return ParameterDescription(
        about.name, found, unit, meaning, words, lower, upper, about.read_only,
        tuple(words.removeprefix(_CHOICES).split(', ')) if words.startswith(_CHOICES) else ())
