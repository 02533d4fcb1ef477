# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Reports: pages in Markdown, figures in JSON, pictures in PNG, and what they were made on.

Imports nothing of ours; matplotlib is imported when a picture is drawn.
"""

from koopman_ros.reports.machine import machine
from koopman_ros.reports.pages import bullets, Picture, table, write_figures, write_page
from koopman_ros.reports.pictures import draw_limits, drawing, DRAWN_RANGE, legend, LIMIT

__all__ = [
    'DRAWN_RANGE',
    'LIMIT',
    'Picture',
    'bullets',
    'draw_limits',
    'drawing',
    'legend',
    'machine',
    'table',
    'write_figures',
    'write_page',
]
