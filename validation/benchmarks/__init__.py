# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Speed of the package beside other programs: ``python -m validation.benchmarks`` measures it."""
