# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tests of the package as a whole: manifest, versions, licence headers, import directions."""

import ast
import functools
import importlib.metadata
from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

from catkin_pkg.package import parse_package
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
import pytest

import koopman_ros

ROOT = Path(__file__).parent.parent
SOURCES = sorted([ROOT / 'setup.py', *(
    path for folder in ('docs', 'koopman_ros', 'examples', 'test', 'validation')
    for path in ROOT.glob(f'{folder}/**/*.py'))])
# What each sub-package may import of the others.
ALLOWED = {
    'plants': set(),
    'lifting': set(),
    'bags': set(),
    'compiled': {'control', 'estimation', 'lifting'},
    'estimation': {'lifting'},
    'control': {'estimation', 'jobs', 'lifting'},
    'learning': {'control', 'jobs', 'lifting'},
    'identification': {'jobs', 'learning', 'lifting', 'plants'},
    'retraining': {'bags', 'control', 'identification', 'jobs', 'learning', 'lifting', 'plants'},
    'replay': {'bags', 'control', 'lifting'},
    'parameters': {'control', 'estimation', 'jobs', 'lifting', 'plants'},
    'jobs': set(),
    'panel': {'bags', 'parameters', 'replay'},
    'ros': {'bags', 'control', 'jobs', 'lifting', 'panel', 'parameters', 'plants', 'replay'},
    'nodes': {'bags', 'control', 'jobs', 'lifting', 'panel', 'parameters', 'plants', 'replay',
              'ros'},
    'testing': {'ros'},
    'demo': {'bags', 'control', 'learning', 'lifting', 'parameters', 'plants', 'ros', 'testing'},
}


@functools.cache
def _imports(path: Path) -> set[str]:
    """List the modules that a file imports, wherever the import stands."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f'{node.module}.{alias.name}' for alias in node.names)
    return names


def test_versions_agree_and_the_manifest_is_of_format_3_and_names_real_people() -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    setup = re.search(r"version='([^']+)'", (ROOT / 'setup.py').read_text())
    assert setup is not None
    assert manifest.findtext('version') == koopman_ros.__version__ == setup.group(1)
    assert f'\n{koopman_ros.__version__} ' in (ROOT / 'CHANGELOG.rst').read_text()
    assert manifest.get('format') == '3'
    assert manifest.findtext('name') == 'koopman_ros'
    assert manifest.findtext('export/build_type') == 'ament_python'
    assert (ROOT / 'resource' / 'koopman_ros').is_file()
    people = [*manifest.findall('maintainer'), *manifest.findall('author')]
    assert people
    for person in people:
        assert 'example' not in (person.get('email') or '')
        assert 'koopman_ros' in (person.text or '')
    assert manifest.findtext('url', '').startswith('https://')


# catkin_pkg's own
@pytest.mark.filterwarnings('ignore::DeprecationWarning')
@pytest.mark.parametrize('control_only', [False, True])
def test_manifest_declares_what_is_imported(control_only: bool) -> None:
    keys = {'torch': 'python3-torch', 'joblib': 'python3-joblib', 'tqdm': 'python3-tqdm',
            'numpy': 'python3-numpy', 'scipy': 'python3-scipy', 'yaml': 'python3-yaml',
            'matplotlib': 'python3-matplotlib', 'rich': 'python3-rich',
            # rosdep has no key for mcap, lz4 and zstandard: they come with this one
            'mcap_ros2': 'mcap-ros2-support', 'mcap': 'mcap-ros2-support',
            'lz4': 'mcap-ros2-support', 'zstandard': 'mcap-ros2-support',
            'control': 'python-control-pip', 'casadi': 'casadi-pip', 'psutil': 'python3-psutil',
            'hypothesis': 'python3-hypothesis', 'rosbags': 'python3-rosbags-pip'}
    learning = {'torch', 'joblib', 'tqdm'}
    manifest = parse_package(ROOT / 'package.xml')
    manifest.evaluate_conditions({'KOOPMAN_ROS_CONTROL_ONLY': '1'} if control_only else {})
    declared = {depend.name for depend in (*manifest.exec_depends, *manifest.test_depends)
                if depend.evaluated_condition}
    used = {name.split('.')[0] for folder in ('koopman_ros', 'test', 'validation')
            for path in ROOT.glob(f'{folder}/**/*.py') for name in _imports(path)}
    assert {keys[name] for name in used & set(keys) - (learning if control_only else set())
            } <= declared
    assert not control_only or not {keys[name] for name in learning} & declared


def test_lock_holds_each_requirement_within_its_range() -> None:
    locked: dict[str, list[Requirement]] = {}
    for line in (ROOT / 'requirements.lock').read_text().splitlines():
        if not line.startswith('#'):
            pin = Requirement(line)
            locked.setdefault(canonicalize_name(pin.name), []).append(pin)
    wanted = [Requirement(text) for text in importlib.metadata.requires('koopman_ros') or ()]
    assert len(wanted) > 20
    for requirement in wanted:
        pins = locked[canonicalize_name(requirement.name)]
        for pin in pins:
            (specifier,) = pin.specifier
            assert specifier.operator == '=='
            assert requirement.specifier.contains(specifier.version), (requirement, pin)


def test_licence_header() -> None:
    header = ('# SPDX-FileCopyrightText: 2026 The koopman_ros Authors\n'
              '# SPDX-License-Identifier: Apache-2.0\n')
    assert not [path for path in SOURCES if not path.read_text().startswith(header)]


@pytest.mark.parametrize('package', sorted(ALLOWED))
def test_imports_run_one_way(package: str) -> None:
    others = {f'koopman_ros.{other}' for other in set(ALLOWED) - ALLOWED[package] - {package}}
    for path in ROOT.glob(f'koopman_ros/{package}/**/*.py'):
        used = {'.'.join(name.split('.')[:2]) for name in _imports(path)}
        assert not used & others, path
        if package not in ('ros', 'nodes', 'demo', 'testing'):
            assert not [name for name in used if re.match(
                r'(rclpy|rcl_|\w+_(msgs|interfaces)(\.|$))', name)], path


def test_nothing_installed_imports_what_is_not_and_few_packages_torch() -> None:
    users = set()
    for path in ROOT.glob('koopman_ros/**/*.py'):
        roots = {name.split('.')[0] for name in _imports(path)}
        assert not roots & {'validation', 'examples', 'support', 'test'}, path
        users |= {path.parent.name} if 'torch' in roots else set()
    assert users == {'identification', 'learning'}
    # and every package has its rule
    assert {path.parent.name for path in ROOT.glob('koopman_ros/*/__init__.py')} == set(ALLOWED)
