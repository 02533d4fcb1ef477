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

"""
Programs of the package: a signal ends them without a traceback while they still load.

A node that is ended by a signal has done its work: 0. A replay has not: 130.
"""

from __future__ import annotations

from functools import partial

from koopman_ros.startup import run_program

plant = partial(run_program, 'koopman_ros.nodes.plant', 0)
controller = partial(run_program, 'koopman_ros.nodes.controller', 0)
trainer = partial(run_program, 'koopman_ros.nodes.trainer', 0)
player = partial(run_program, 'koopman_ros.nodes.player', 0)
replay = partial(run_program, 'koopman_ros.nodes.replay', 130)
