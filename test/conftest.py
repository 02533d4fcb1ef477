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

"""Every message that a test or a node under test makes is checked, field by field."""

import os

# An int in a float64 field, say, passes unnoticed here, and aborts the process where the message
# packages are built with asserts. The packages read this when they are imported.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
