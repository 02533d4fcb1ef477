# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What tests of several files share: small plants, random lifts, bags, closed loops, processes."""

INSTALL_CHROMIUM = 'sudo apt-get install chromium'
