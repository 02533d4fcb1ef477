# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What is computed and tried of the package, from its repository: no part of what is installed."""
