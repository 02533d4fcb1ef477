# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Names of the model classes, by which one is selected; without torch."""

LINEAR, POLYNOMIAL, NEURAL_DRIFT = 'linear', 'polynomial', 'neural drift'
IDENTITY_LIFT, FREE_LIFT = 'identity lift', 'free lift'
#: those that are tried, the plainest first
CLASSES = (LINEAR, POLYNOMIAL, NEURAL_DRIFT, IDENTITY_LIFT, FREE_LIFT)
#: stands for the one that the rule of the choice takes
BEST = 'best'
#: stands for that of the current model, or for the best of a first one
SAME = 'same'
