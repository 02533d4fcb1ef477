# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""How fast the package is, beside other programs; ``python -m benchmarks`` runs the parts."""
