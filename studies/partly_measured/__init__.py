# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Partly measured plants, compared with do-mpc and a plain LQG; see ``make studies-partial``."""
