# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Training beside other solvers: seconds to a given accuracy, and how the cost grows.

Each measurement runs in a process of its own (:mod:`~validation.benchmarks.training.worker`), on
one thread; the process that runs them imports no torch.
"""
