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
Retraining of the controller's lift from what was recorded, as a process of its own.

Imports bags, identification, learning, lifting and control; needs the `train` requirements. Nodes
do not import it, they start ``python -m koopman_ros.retraining``.
"""

from koopman_ros.retraining.gate import judge, Thresholds, Verdict
from koopman_ros.retraining.lift import learn_lift
from koopman_ros.retraining.report import write_report
from koopman_ros.retraining.task import Outcome, retrain, Task

__all__ = [
    'Outcome',
    'Task',
    'Thresholds',
    'Verdict',
    'judge',
    'learn_lift',
    'retrain',
    'write_report',
]
