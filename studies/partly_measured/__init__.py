# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Plants measured in part, beside do-mpc and a plain LQG; see ``make studies-partial``."""
