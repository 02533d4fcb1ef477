# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the methods achieve, computed: shipped models and experiments; imports all but nodes."""
