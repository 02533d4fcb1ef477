# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A node that goes on compiled, in a domain of its own."""

from support.nodes import ros, type_support

__all__ = ['ros', 'type_support']
