# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What the loop survives: faults put into it on purpose, each judged by figures.

``python -m validation.faults`` runs the cases and the endurance run across real processes.
"""
