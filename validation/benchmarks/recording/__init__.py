# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
What recording costs: a trainer fed by a publisher, our writer and mcap's fed from memory.

Trainer and publisher are processes of their own on loopback; the messages are numbered
temperatures, and what was lost is counted by these numbers.
"""
