# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A short run of one part of the benchmark, that of the module's PLAN."""

import warnings

import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from validation.benchmarks.options import Extent, Options


@pytest.fixture(scope='module')
def run(request, tmp_path_factory):
    """Return the figures of the module's `part` by its `PLAN`, and the keys saved on the way."""
    part, saved = request.module.part, []
    with warnings.catch_warnings():
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(part.PLANS, Extent.QUICK, request.module.PLAN)
        figures = part.run(Options(tmp_path_factory.mktemp('bench'), Extent.QUICK, None,
                                   lambda so_far: saved.append(set(so_far))))
    return figures, saved
