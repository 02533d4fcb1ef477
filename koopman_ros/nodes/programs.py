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

"""Programs of the package: an interrupt ends them without a traceback while they still load."""

from __future__ import annotations

from functools import partial
import importlib
import signal


def _run(name: str) -> int:
    # numpy, scipy and rclpy take half a second
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    program = importlib.import_module(f'koopman_ros.nodes.{name}')
    signal.signal(signal.SIGINT, handler)
    code: int = program.main()
    return code


plant = partial(_run, 'plant')
controller = partial(_run, 'controller')
trainer = partial(_run, 'trainer')
player = partial(_run, 'player')
replay = partial(_run, 'replay')
