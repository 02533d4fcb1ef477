# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sphinx over the pages, README and CONTRIBUTING among them, and the docstrings: `make docs`."""

from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

project = 'koopman_ros'
author = 'The koopman_ros Authors'
copyright = f'2026, {author}'  # noqa: A001

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.autosummary']
templates_path = ['_templates']
# the pages are written for GitHub, too: its fence and its anchors
myst_enable_extensions = ['dollarmath']
myst_fence_as_directive = ['math']
myst_heading_anchors = 3

# The reference is built without ROS and without torch.
autodoc_mock_imports = ['builtin_interfaces', 'cloudpickle', 'diagnostic_msgs', 'distributed',
                        'joblib', 'lifecycle_msgs', 'matplotlib', 'rcl_interfaces', 'rclpy',
                        'rosgraph_msgs', 'sensor_msgs', 'std_msgs', 'std_srvs', 'torch', 'tqdm',
                        # of the panel
                        'fastapi', 'nicegui', 'starlette', 'uvicorn']
autodoc_typehints = 'description'
autodoc_typehints_format = 'short'
autodoc_type_aliases = {'Array': 'Array', 'FloatArray': 'Array'}

html_theme = 'furo'
html_title = project

# Pages that stand beside the folder, by the names that they have in it.
BESIDE = {'index': 'README.md', 'contributing': 'CONTRIBUTING.md'}


def setup(app):
    """Have pages read from beside the folder."""
    app.connect('source-read', _read_from_beside)


def _read_from_beside(_, page, content):
    """Put a page from beside the folder before what stands in it, with its links led from here."""
    source = ROOT / BESIDE.get(page, '')
    if source.is_file():
        text = source.read_text().replace('](docs/', '](').replace('](LICENSE)', '](../LICENSE)')
        for name, file in BESIDE.items():
            text = text.replace(f']({file}', f']({name}.md')
        content[0] = text + content[0]
