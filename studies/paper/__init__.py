# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Results of the methods: bundled models and experiments; imports all but nodes."""
