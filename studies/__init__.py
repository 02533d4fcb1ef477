# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Studies and experiments with the package, from its repository; not part of an installation."""
