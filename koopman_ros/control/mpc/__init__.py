# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Model predictive control, with the package daqp (the extra ``mpc``)."""

from koopman_ros.control.mpc.law import MPCParameters, RecedingHorizon

__all__ = ['MPCParameters', 'RecedingHorizon']
