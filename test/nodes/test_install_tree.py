# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The package as it is installed: by colcon, as `ros2 run` finds it, and as a wheel by pip.

The wheel is built from a source archive. Processes are started from either. Those of the wheel
have an environment of their own, which notes every file of the repository that is opened in it.
"""

import os
from pathlib import Path
import shutil
import site
import sys
import venv

import pytest

from koopman_ros.testing import Harness
from support.installation import Installation, ROOT, run, sources, underlay

NODES = {'plant': 'simulation', 'controller': 'control', 'trainer': 'recording'}
# Notes what is opened below the repository, but for the environment that the tests run in. `open`
# is an audit event of imports and of files alike.
NOTING = f"""
import os, sys

def note(event, arguments):
    if event == 'open' and isinstance(arguments[0], (str, bytes)):
        path = os.path.realpath(os.fsdecode(arguments[0]))
        if path.startswith({f'{ROOT}/'!r}) and not path.startswith({f'{sys.prefix}/'!r}):
            os.write(notes, (path + chr(10)).encode())

notes = os.open({{file!r}}, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
sys.addaudithook(note)
"""

@pytest.fixture(scope='module')
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    """
    Build a wheel from a source archive, and install it into an empty environment.

    Requirements are those of here.
    """
    folder = tmp_path_factory.mktemp('wheel')
    (folder / 'built').mkdir()

    def build(kind: str, pattern: str, where: Path) -> Path:
        built = run((sys.executable, '-c', 'import sys; from setuptools import build_meta; '
                     f'build_meta.build_{kind}(sys.argv[1])', str(folder / 'built')), cwd=where)
        assert built.returncode == 0, built.stdout + built.stderr
        (found,) = (folder / 'built').glob(pattern)
        return found

    archive = build('sdist', '*.tar.gz', sources(folder / 'source'))
    shutil.unpack_archive(archive, folder / 'unpacked', filter='data')
    (unpacked,) = (folder / 'unpacked').iterdir()
    wheel = build('wheel', '*.whl', unpacked)
    venv.create(folder / 'environment', symlinks=True)
    environment = folder / 'environment'
    installed = run((sys.executable, '-m', 'pip', '--python', str(environment / 'bin/python'),
                     'install', '--quiet', '--no-deps', '--no-index', '--ignore-installed',
                     str(wheel)))
    assert installed.returncode == 0, installed.stderr
    (own,) = environment.glob('lib/python*/site-packages')
    notes = folder / 'notes'
    (own / 'noting.py').write_text(NOTING.format(file=str(notes)))
    # a folder that a .pth adds is not searched for further .pth: an editable install stays out
    (own / 'here.pth').write_text('\n'.join([*site.getsitepackages(), 'import noting\n']))
    return Installation(
        environment / 'bin', environment / 'share' / 'koopman_ros', own / 'koopman_ros',
        underlay(), environment / 'bin' / 'python', notes)


@pytest.fixture(params=['colcon', 'wheel'])
def installation(request: pytest.FixtureRequest) -> Installation:
    found: Installation = request.getfixturevalue(request.param)
    return found


def test_everything_is_installed(installation: Installation) -> None:
    for name in (*NODES, 'player', 'replay', 'panel'):
        executable = installation.executables / name
        assert executable.is_file()
        assert os.access(executable, os.X_OK)
    share = installation.share
    assert (share.parent / 'ament_index/resource_index/packages/koopman_ros').is_file()
    assert (share / 'package.xml').is_file()
    assert (share / 'launch' / 'loop.launch.py').is_file()
    shipped = {path.relative_to(ROOT / 'config') for path in (ROOT / 'config').rglob('*.*')}
    assert {path.relative_to(share / 'config')
            for path in (share / 'config').rglob('*.*')} == shipped
    assert Path('models/reactor_nz4.safetensors') in shipped
    for name in ('export/templates', 'panel/login.html', 'panel/style.css', 'panel/watch.js'):
        assert (installation.package / name).exists()
    # the package alone, not what validates it
    beside = {path.name for path in installation.package.parent.iterdir()}
    assert 'koopman_ros' in beside
    assert not {'studies', 'benchmarks', 'test', 'examples', 'support'} & beside
    program = ('import koopman_ros; from koopman_ros.core.paths import config_directory; '
               'print(koopman_ros.__file__); print(config_directory())')
    ended = run(installation.command(str(installation.python), '-c', program))
    assert ended.stdout.split() == [str(installation.package / '__init__.py'),
                                    str(installation.share / 'config')], ended.stderr


def test_nodes_of_the_wheel_start_with_their_parameter_files_and_end(
        ros: Harness, wheel: Installation, tmp_path: Path) -> None:
    started = [ros.start(
        name, {'output': tmp_path / 'bag'} if name == 'trainer' else {},
        ('--params-file', str(wheel.share / 'config' / f'{name}.yaml')),
        command=wheel.command(str(wheel.executables / name))) for name in NODES]
    for name, task in NODES.items():
        ros.wait_for_status(f'{name}: {task}', lambda status: True)
    assert [process.stop() for process in started] == [0, 0, 0]
    assert wheel.opened() == ''
