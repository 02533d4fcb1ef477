# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Speed of the predictive law compared with other programs, by ``python -m benchmarks``."""

import os

# Before numpy is imported, here and by the processes that are started: with so few numbers other
# threads only wait and spin.
for library in ('OMP', 'OPENBLAS', 'MKL'):
    os.environ[f'{library}_NUM_THREADS'] = '1'
