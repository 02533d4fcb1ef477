# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Tests of the package as a whole: manifest, versions, licence headers, import directions."""

import ast
from collections import Counter
import functools
import importlib.metadata
from pathlib import Path
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree

from catkin_pkg.package import Dependency, parse_package
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
import pytest
import yaml

import koopman_ros
from support.distributions import installed_with, loaded, modules_without, providers

ROOT = Path(__file__).parent.parent
SOURCES = sorted([ROOT / 'setup.py', *(
    path for folder in ('docs', 'koopman_ros', 'examples', 'test', 'studies', 'benchmarks')
    for path in ROOT.glob(f'{folder}/**/*.py'))])
# What each sub-package may import of the others; core, all of them.
ALLOWED = {
    'core': set(),
    'plants': set(),
    'model': set(),
    'records': set(),
    'estimation': {'model'},
    'control': {'estimation', 'model'},
    'evaluation': {'control', 'estimation', 'execution', 'model', 'plants'},
    'learning': {'records', 'control', 'evaluation', 'execution', 'model', 'plants'},
    'event_log': {'records', 'control', 'model', 'parameters'},
    'parameters': {'control', 'estimation', 'evaluation', 'execution', 'model', 'plants'},
    'execution': set(),
    'export': {'control', 'estimation', 'model', 'parameters'},
    'panel': {'records', 'execution', 'model', 'parameters', 'event_log'},
    'ros': {'control', 'evaluation', 'event_log', 'execution', 'model', 'parameters', 'plants',
            'records'},
    'nodes': {'control', 'evaluation', 'event_log', 'execution', 'model', 'panel', 'parameters',
              'plants', 'records', 'ros'},
    'testing': {'ros'},
    'demo': {'control', 'evaluation', 'export', 'learning', 'model', 'parameters', 'plants',
             'records', 'ros', 'testing'},
}


@functools.cache
def _names(path: Path) -> tuple[set[str], list[str]]:
    """List the modules that a file imports, wherever that stands, and its classes."""
    modules, classes = set(), []
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Import(names=names):
                modules |= {alias.name for alias in names}
            case ast.ImportFrom(module=str(module), names=names):
                modules |= {module, *(f'{module}.{alias.name}' for alias in names)}
            case ast.ClassDef(name=name):
                classes.append(name)
    return modules, classes


def test_versions_agree_and_the_manifest_is_of_format_3_and_names_real_people() -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert manifest.findtext('version') == koopman_ros.__version__
    # as ROS tools read it: changes that are not released yet are first
    assert re.search(r'^(Forthcoming|\d+\.\d+\.\d+ \(\d{4}-\d{2}-\d{2}\))\n-+$',
                     (ROOT / 'CHANGELOG.rst').read_text(), re.MULTILINE)
    assert manifest.get('format') == '3'
    assert manifest.findtext('name') == 'koopman_ros'
    assert manifest.findtext('export/build_type') == 'ament_python'
    assert (ROOT / 'resource' / 'koopman_ros').is_file()
    people = [*manifest.findall('maintainer'), *manifest.findall('author')]
    assert people
    for person in people:
        assert 'example' not in (person.get('email') or '')
        assert 'koopman_ros' in (person.text or '')
    urls = {url.get('type'): url.text or '' for url in manifest.findall('url')}
    assert set(urls) == {'repository', 'bugtracker', 'website'}
    assert all(url.startswith('https://') for url in urls.values())


@pytest.mark.filterwarnings('ignore::DeprecationWarning')
def test_a_debian_package_needs_no_key_that_pip_installs() -> None:
    manifest = parse_package(ROOT / 'package.xml')
    manifest.evaluate_conditions({'KOOPMAN_ROS_WITHOUT_PIP': '1'})
    assert not {one.name for one in manifest.exec_depends if one.evaluated_condition} & {
        *_keys()['pip']}


def test_metadata_of_the_distribution_are_those_of_the_manifest() -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    found = subprocess.run(
        [sys.executable, 'setup.py', '--version', '--maintainer', '--maintainer-email'], cwd=ROOT,
        capture_output=True, text=True, check=True).stdout.splitlines()[-3:]
    maintainer = manifest.find('maintainer')
    assert maintainer is not None
    assert found == [manifest.findtext('version'), maintainer.text, maintainer.get('email')]


def _keys() -> dict[str, dict[str, list[str]]]:
    """Return what rosdep knows: by the way of installing, each key with its modules."""
    keys: dict[str, dict[str, list[str]]] = yaml.safe_load(
        (ROOT / 'test' / 'rosdep_keys.yaml').read_text())
    return keys


def _third_party(*folders: str) -> set[str]:
    """Return the modules of other distributions that the files in folders import."""
    own = {'koopman_ros', 'studies', 'benchmarks', 'support', 'machines', 'walkthrough'}
    return {name.split('.')[0] for folder in folders for path in ROOT.glob(f'{folder}/**/*.py')
            for name in _names(path)[0]} - own - sys.stdlib_module_names


# catkin_pkg's own
@pytest.mark.filterwarnings('ignore::DeprecationWarning')
@pytest.mark.parametrize('control_only', [False, True])
def test_the_manifest_declares_all_imports(control_only: bool) -> None:
    keys = _keys()
    key_of = {module: key for kind in ('ros', 'apt', 'pip') for key, modules in keys[kind].items()
              for module in modules}
    without = {module for modules in keys['none'].values() for module in modules}
    # optional, or a part of the training
    learning = {'torch', 'joblib', 'tqdm', 'pandas'} if control_only else set()
    manifest = parse_package(ROOT / 'package.xml')
    manifest.evaluate_conditions({'KOOPMAN_ROS_CONTROL_ONLY': '1'} if control_only else {})

    def declared(*depends: list[Dependency]) -> set[str]:
        return {one.name for some in depends for one in some if one.evaluated_condition}

    nodes = declared(manifest.exec_depends)
    everything = declared(manifest.exec_depends, manifest.test_depends)
    used = _third_party('koopman_ros') - without
    assert {key_of[name] for name in used - learning} <= nodes
    assert {key_of[name] for name in _third_party('koopman_ros', 'test', 'studies', 'benchmarks')
            - without - learning} <= everything
    assert not {key_of[name] for name in learning} & everything


@pytest.mark.filterwarnings('ignore::DeprecationWarning')
def test_rosdep_has_every_key_of_the_manifest_and_the_page_names_the_rest() -> None:
    keys = _keys()
    manifest = parse_package(ROOT / 'package.xml')
    nodes, tests = ({one.name for one in some}
                    for some in (manifest.exec_depends, manifest.test_depends))
    assert nodes | tests <= {*keys['ros'], *keys['apt'], *keys['pip']}
    assert not set(keys['none']) & {key for kind in ('ros', 'apt', 'pip') for key in keys[kind]}
    assert nodes & set(keys['pip']) == {'mcap-ros2-support', 'python3-rosbags-pip'}
    _, _, install = (ROOT / 'docs' / 'how-to' / 'install.md').read_text().partition('# Install')
    assert not [key for key in keys['pip'] if f'`{key}`' not in install]
    assert not [name for name in keys['none'] if not re.search(rf'install[^`]*\b{name}', install)
                and f'python3-{name}' not in install]


@pytest.mark.filterwarnings('ignore::DeprecationWarning')
@pytest.mark.parametrize(('control_only', 'modules'), [
    (False, 'plant controller trainer player replay'), (False, 'panel'),
    (True, 'plant controller trainer')])
def test_nodes_import_with_the_packages_of_the_page_alone(control_only: bool, modules: str
                                                          ) -> None:
    """Where control_only, without what the page leaves out then; the panel with what it adds."""
    keys = _keys()
    manifest = parse_package(ROOT / 'package.xml')
    manifest.evaluate_conditions({'KOOPMAN_ROS_CONTROL_ONLY': '1'} if control_only else {})
    modules_of = {**keys['ros'], **keys['apt'], **keys['pip']}
    named = {name for one in manifest.exec_depends if one.evaluated_condition
             for name in modules_of[one.name]}
    page = (ROOT / 'docs' / 'how-to' / 'install.md').read_text()
    (commands, *_) = re.findall(r'```sh\n(.*?)```', page, re.DOTALL)
    named |= set(re.findall(r'python3-(\w+)', commands))
    named |= {name for line in re.findall(r'^pip install(.*)$', commands, re.MULTILINE)
              for name in line.split() if not name.startswith('-')}
    if control_only:
        named -= {'cloudpickle'}
    if modules == 'panel':
        (more,) = re.findall(r'`pip install ([^`]*)` for the \[panel\]', page)
        named |= {re.split(r'[>=]', word.strip("'"))[0] for word in more.split()}
    there = installed_with(*(name for module in named for name in providers().get(module, ())))
    nodes = [f'koopman_ros.nodes.{name}' for name in modules.split()]
    learning = ['koopman_ros.learning', 'koopman_ros.execution.pools'] * (
        modules != 'panel' and not control_only)
    assert set(nodes) <= loaded(
        ', '.join([*nodes, *learning]), modules_without({*there, 'koopman-ros'}))


@pytest.mark.parametrize('manifest', ['package.xml', 'examples/oven/package.xml'])
def test_conditions_of_a_manifest_have_the_characters_of_its_schema(manifest: str) -> None:
    """As package_format3.xsd has them: no quotes."""
    conditions = {one.attrib.get('condition', '') for one in ElementTree.parse(ROOT / manifest
                                                                               ).iter()}
    assert not [one for one in conditions if not re.fullmatch(r'[$A-Za-z0-9_\s<>!=()-]*', one)]


def test_packages_that_messages_and_pages_advise_are_known() -> None:
    """Distributions of the lock, and none of this package, which is not on PyPI."""
    locked = {canonicalize_name(Requirement(line).name) for line in (
        ROOT / 'requirements.lock').read_text().splitlines() if not line.startswith('#')}
    texts = {path: path.read_text() for path in (
        *ROOT.glob('*.md'), *ROOT.glob('docs/**/*.md'), *ROOT.glob('koopman_ros/**/*.py'),
        *ROOT.glob('studies/**/*.py'), *ROOT.glob('benchmarks/*.py'), *ROOT.glob('config/*.yaml'))}
    assert not [path for path, text in texts.items() if 'koopman_ros[' in text]
    advised = {name for text in texts.values() for name in re.findall(
        r"pip install '?([a-z][\w-]*)", text)}
    assert {'matplotlib', 'nicegui', 'torch'} <= advised
    assert {canonicalize_name(name) for name in advised} <= locked


def test_options_of_pytest_are_those_of_its_release_7_4() -> None:
    """Which a sourced Jazzy has; an unknown one ends it."""
    options = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['pytest']['ini_options']
    # and of pytest-timeout, which the manifest names
    assert set(options) <= {'testpaths', 'pythonpath', 'addopts', 'filterwarnings',
                            'faulthandler_timeout', 'timeout'}
    # launch_testing's plug-in has an argument that pytest 9 does not know
    assert {'no:launch_testing', 'no:launch_ros', 'no:launch_pytest'} <= set(
        options['addopts'].split())


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
    others = {f'koopman_ros.{other}'
              for other in set(ALLOWED) - ALLOWED[package] - {package, 'core'}}
    for path in ROOT.glob(f'koopman_ros/{package}/**/*.py'):
        used = {'.'.join(name.split('.')[:2]) for name in _names(path)[0]}
        assert not used & others, path
        if package not in ('ros', 'nodes', 'demo', 'testing'):
            assert not [name for name in used if re.match(
                r'(rclpy|rcl_|\w+_(msgs|interfaces)(\.|$))', name)], path


def test_no_class_name_has_two_meanings() -> None:
    found = Counter(name for folder in ('koopman_ros', 'studies', 'benchmarks')
                    for path in ROOT.glob(f'{folder}/**/*.py') for name in _names(path)[1])
    assert sorted(name for name, count in found.items() if count > 1) == []


def test_installed_code_imports_only_installed_code_and_few_packages_import_torch() -> None:
    users, planners = set(), set()
    for path in ROOT.glob('koopman_ros/**/*.py'):
        roots = {name.split('.')[0] for name in _names(path)[0]}
        assert not roots & {'studies', 'benchmarks', 'examples', 'support', 'test'}, path
        room = path.relative_to(ROOT).parts[1]
        users |= {room} if 'torch' in roots else set()
        planners |= {path.parent.name} if 'daqp' in roots else set()
    assert users == {'learning'}
    assert planners == {'mpc'}
    # and every package has its rule
    assert {path.parent.name for path in ROOT.glob('koopman_ros/*/__init__.py')} == set(ALLOWED)
