# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Compiled numerics of a control step, by numba; they give what numpy gives.

Importing :mod:`koopman_ros.compiled.table` loads them all, and compiles what is not kept on the
disk yet, which takes half a minute.
"""
