# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Command line for topics, services and parameters, where ``ros2`` is not installed."""

import argparse
from collections.abc import Callable, Iterator
import contextlib
import math
import os
import re
import sys
import time
from typing import Any, TypeVar

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future
import yaml

from koopman_ros import __version__
from koopman_ros.core.yaml_text import load_yaml
from koopman_ros.ros import topics
from koopman_ros.ros.managed import one_line
from koopman_ros.ros.process import init
from koopman_ros.ros.remote_node import repeated

T = TypeVar('T')
_HISTORY = 100  # messages
_ASK_AGAIN = 5.0  # s


class CommandError(Exception):
    """A command that cannot be carried out, with the reason in a sentence."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return 0, or 1 with a reason on standard error."""
    options = _parser().parse_args(arguments)
    try:
        with _node() as node:
            _check(node, options)
            options.run(node, options)
    except CommandError as error:
        print(f'koopman_ros: {error}', file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser('koopman_ros', description=__doc__)
    parser.add_argument('--version', action='version', version=__version__)
    commands = parser.add_subparsers(required=True, metavar='COMMAND')

    def add(verb: str, run: Callable[[Node, argparse.Namespace], None], about: str,
            **arguments: dict[str, Any]) -> None:
        command = commands.add_parser(verb, help=about, description=about)
        command.set_defaults(run=run)
        for flag, options in arguments.items():
            command.add_argument(f'--{flag}' if 'default' in options else flag, **options)
        command.add_argument('--timeout', type=float, default=30.0, metavar='S',
                             help='longest wait (default: %(default)s s)')

    message_type = {'default': '', 'metavar': 'TYPE',
                    'help': 'message type, needed if no node uses the topic yet'}
    add('pub', _publish, 'publish one message', topic={},
        message={'help': "fields in YAML: '{temperature: 45.0}'"}, type=message_type)
    add('echo', _echo, 'print the messages of a topic', topic={}, count={
        'type': int, 'default': 0, 'metavar': 'N', 'help': 'end after N messages'},
        type=message_type)
    add('call', _call, 'call a service', service={}, request={
        'nargs': '?', 'help': "fields in YAML: '{data: true}'"})
    add('param', _parameter, 'list, read or set parameters of a node',
        node={}, name={'nargs': '?'}, value={'nargs': '?', 'help': 'new value, in YAML'})
    return parser


@contextlib.contextmanager
def _node() -> Iterator[Node]:
    init([])
    node = rclpy.create_node(f'koopman_ros_{os.getpid()}', start_parameter_services=False)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _check(node: Node, options: argparse.Namespace) -> None:
    """Raise CommandError for a name or a number that cannot be used."""
    for kind in ('topic', 'service', 'node'):
        if (name := getattr(options, kind, None)) is not None:
            try:
                # a node's name is as one of a topic
                node.resolve_topic_name(name)
            except (RuntimeError, ValueError) as error:
                raise CommandError(f'{name!r} is not a name of a {kind} ({one_line(error)}): use '
                                   'e.g. /line_1/temperature') from error
    for option, least in (('timeout', 0.0), ('count', 0)):
        value = getattr(options, option, least)
        if not least <= value < math.inf:
            raise CommandError(f'--{option} {value} must be at least {least:g}, and finite')


def _wait(node: Node, seconds: float, found: Callable[[], T], missing: str) -> T:
    """Return the first result that is true; CommandError after some seconds."""
    end = time.monotonic() + seconds
    while not (result := found()):
        if time.monotonic() > end:
            raise CommandError(missing)
        rclpy.spin_once(node, timeout_sec=0.05)
    return result


def _repeated(node: Node, options: argparse.Namespace, request: Callable[[], Future]) -> Any:
    future = _wait(node, options.timeout, repeated(request, _ASK_AGAIN), (
        f'{options.node} did not respond within {options.timeout:g} s'))
    assert future is not None
    return future.result()


def _kind(node: Node, options: argparse.Namespace) -> Any:
    """Return the class of a topic's messages."""
    topic = node.resolve_topic_name(options.topic)
    name = options.type or _wait(
        node, options.timeout, lambda: dict(node.get_topic_names_and_types()).get(topic, []),
        f'no node uses {topic}: check its name and the ROS domain, or set --type')[0]
    return _class(name)


def _class(name: str) -> Any:
    try:
        return topics.message_class(name)
    except LookupError as error:
        raise CommandError(str(error)) from error


def _filled(message: Any, text: str | None) -> Any:
    """Set fields of a message from YAML."""
    def fill(part: Any, values: Any) -> None:
        kinds = part.get_fields_and_field_types()
        if not isinstance(values, dict) or not set(values) <= set(kinds):
            raise ValueError(f'the fields are {", ".join(kinds)}')
        for name, value in values.items():
            if '/' in kinds[name] and isinstance(value, dict):
                fill(getattr(part, name), value)
                continue
            if 'double' in kinds[name] or 'float' in kinds[name]:
                # 45 stands for 45.0
                value = [*map(float, value)] if isinstance(value, list) else float(value)
            elif bits := re.search(r'(u?)int(\d+)', kinds[name]):
                # the middleware would send the number without its upper bits
                lowest, size = -2 ** (int(bits[2]) - 1) * (not bits[1]), 2 ** int(bits[2])
                for number in value if isinstance(value, list) else [value]:
                    if type(number) is not int or not 0 <= number - lowest < size:
                        raise ValueError(f'{name} = {number} must be an integer from {lowest} to '
                                         f'{lowest + size - 1}')
            setattr(part, name, value)

    try:
        fill(message, load_yaml(text or '{}'))
    except (AssertionError, TypeError, ValueError) as error:
        raise CommandError(f'{text!r} is not a valid {type(message).__name__}: {error}') from error
    return message


def _plain(value: Any) -> Any:
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: _plain(getattr(value, name))
                for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return [*value]
    if isinstance(value, (str, bool, int, float)):
        return value
    return [_plain(item) for item in value]


def _show(value: Any) -> None:
    print(yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=math.inf), end='')


def _publish(node: Node, options: argparse.Namespace) -> None:
    kind = _kind(node, options)
    message = _filled(kind(), options.message)
    publisher = node.create_publisher(kind, options.topic, topics.profile(1, reliable=True))
    _wait(node, options.timeout, lambda: (
        0 < node.count_subscribers(options.topic) <= publisher.get_subscription_count()),
        f'no node subscribes to {options.topic}: nothing was published')
    publisher.publish(message)
    publisher.wait_for_all_acked()


def _echo(node: Node, options: argparse.Namespace) -> None:
    kind = _kind(node, options)
    received: list[Any] = []
    node.create_subscription(kind, options.topic, received.append, topics.matching_profile(
        topics.LOOP_QOS, node.get_publishers_info_by_topic(options.topic), _HISTORY))
    shown = 0
    while not options.count or shown < options.count:
        _show(_plain(_wait(node, options.timeout, lambda: received and received.pop(0),
                           f'no message on {options.topic} for {options.timeout:g} s')))
        print('---', flush=True)
        shown += 1


def _call(node: Node, options: argparse.Namespace) -> None:
    service = node.resolve_service_name(options.service)
    missing = f'no service {service}: check its name and the ROS domain'
    kind = _class(_wait(
        node, options.timeout, lambda: dict(node.get_service_names_and_types()).get(service, []),
        missing)[0])
    client = node.create_client(kind, service)
    _wait(node, options.timeout, client.service_is_ready, missing)
    future = client.call_async(_filled(kind.Request(), options.request))
    _wait(node, options.timeout, future.done,
          f'{service} did not respond within {options.timeout:g} s')
    response = future.result()
    _show(_plain(response))
    if not getattr(response, 'success', True):
        raise CommandError(f'{service} rejected')


def _parameter(node: Node, options: argparse.Namespace) -> None:
    client = AsyncParameterClient(node, options.node)
    _wait(node, options.timeout, client.services_are_ready,
          f'no node {options.node}: check its name and the ROS domain')

    def read(names: list[str]) -> list[Any]:
        return [parameter_value_to_python(value) for value in _repeated(
            node, options, lambda: client.get_parameters(names)).values]

    if options.name is None:
        listed = _repeated(node, options, client.list_parameters)
        names = sorted(listed.result.names)
        for name, value in zip(names, read(names), strict=True):
            print(f'{name}: {value}')
        return
    present = read([options.name])
    if not present or present[0] is None:
        raise CommandError(f'{options.node} has no parameter {options.name}')
    if options.value is None:
        print(present[0])
        return
    try:
        value = options.value if isinstance(present[0], str) else load_yaml(options.value)
    except ValueError as error:
        raise CommandError(f'{options.value!r}: {error}') from error
    if isinstance(present[0], float) and isinstance(value, int):
        value = float(value)
    result, = _repeated(node, options, lambda: client.set_parameters(
        [Parameter(options.name, value=value)])).results
    if not result.successful:
        raise CommandError(result.reason)


if __name__ == '__main__':
    sys.exit(main())
