# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Life of a node's process: start, one-line reason on a bad start, clean end on a signal."""

from __future__ import annotations

from collections.abc import Callable
import sys

from koopman_ros.lifting import ModelFileError
from koopman_ros.nodes.parameters import ConfigurationError
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

# rclpy raises RCLError for an unreadable parameter file; its class is private to the extension.
_START_ERRORS = (ConfigurationError, ModelFileError, OSError, ParameterException, RuntimeError,
                 ValueError)


def run(name: str, create: Callable[[], Node], args: list[str] | None = None) -> int:
    """
    Run a node until SIGINT or SIGTERM.

    :param name: word that starts an error line.
    :param create: builds the node.
    :param args: command line, or None for the process's own.
    :return: exit code, 0 after a signal and 1 when the node could not start.
    """
    node = None
    try:
        try:
            rclpy.init(args=args)
            node = create()
        except _START_ERRORS as error:
            print(f'{name}: cannot start: {_one_line(error)}', file=sys.stderr)
            return 1
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _one_line(error: Exception) -> str:
    """Return an error's text on one line; rcl repeats itself over several."""
    text = str(error).split(', at ./')[0].split(', at /')[0]
    return ' '.join(text.split()) or type(error).__name__
