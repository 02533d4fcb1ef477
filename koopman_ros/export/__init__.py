# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Export of a control loop as C code."""

from koopman_ros.export.c_code import c_code, compiled, ExportError
from koopman_ros.export.folder import export_c

__all__ = ['ExportError', 'c_code', 'compiled', 'export_c']
