# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sphinx configuration of `make docs`: pages, README, CONTRIBUTING and docstrings."""

from pathlib import Path
import sys

# its checks of array types fail beside a stand-in of torch
import scipy.stats  # noqa: F401

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

project = 'koopman_ros'
author = 'The koopman_ros Authors'
copyright = f'2026, {author}'  # noqa: A001

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.autosummary']
templates_path = ['_templates']
# fences and anchors as on GitHub, where the pages are also read
myst_enable_extensions = ['dollarmath']
myst_fence_as_directive = ['math']
myst_heading_anchors = 3

# The reference is built without ROS and without torch.
autodoc_mock_imports = ['builtin_interfaces', 'cloudpickle', 'diagnostic_msgs', 'distributed',
                        'joblib', 'lifecycle_msgs', 'matplotlib', 'rcl_interfaces', 'rclpy',
                        'rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs', 'torch', 'tqdm',
                        'trajectory_msgs',
                        # panel
                        'fastapi', 'nicegui', 'starlette', 'uvicorn']
autodoc_typehints = 'description'
autodoc_typehints_format = 'short'
autodoc_type_aliases = {'Array': 'Array', 'FloatArray': 'Array'}

html_theme = 'furo'
html_title = project

# Files outside docs/ that begin a page, by its name.
OUTSIDE = {'index': 'README.md', 'contributing': 'CONTRIBUTING.md'}


def setup(app):
    """Include files from outside docs/."""
    app.connect('source-read', _include_outside)


def _include_outside(_, page, content):
    """Put a file from outside docs/ before a page, with its links adjusted."""
    source = ROOT / OUTSIDE.get(page, '')
    if source.is_file():
        text = source.read_text().replace('](docs/', '](').replace('](LICENSE)', '](../LICENSE)')
        for name, file in OUTSIDE.items():
            text = text.replace(f']({file}', f']({name}.md')
        content[0] = text + content[0]
