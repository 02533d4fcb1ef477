# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Files: places of the shipped configuration and of models, and atomic writing."""

import os
from pathlib import Path
import sys
import tempfile

LOOPBACK_PROFILE = 'loopback_discovery.xml'
LEAN_PROFILE = 'many_loops.xml'

_PACKAGE = 'koopman_ros'


def config_directory() -> Path:
    """Return the folder of the shipped files; FileNotFoundError when it is not installed."""
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    package = Path(__file__).resolve().parents[1]
    # an install tree without its environment: <prefix>/lib/python3.x/site-packages/koopman_ros
    prefixes += [Path(sys.prefix), *package.parents[2:4]]
    candidates = [package.parent / 'config']
    candidates += [prefix / 'share' / _PACKAGE / 'config' for prefix in prefixes]
    for candidate in candidates:
        if (candidate / 'models').is_dir():
            return candidate
    raise FileNotFoundError(f'the folder share/{_PACKAGE}/config is missing: reinstall the '
                            'package, or source the workspace that provides it')


def backup_path(path: Path) -> Path:
    """Return where the model is kept that a training replaced in a file."""
    return path.with_suffix('.previous.safetensors')


def model_path(model: str) -> Path:
    """Return the file of a model given by name, e.g. ``reactor_nz4``, or by path."""
    if model.endswith('.safetensors') or os.sep in model:
        return Path(model).expanduser()
    return config_directory() / 'models' / f'{model}.safetensors'


def write_atomically(path: Path, content: bytes, mode: int = 0o666) -> None:
    """Replace a file; a reader sees the old content or the new, after a loss of power as well."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f'{path.name}.',
                                     suffix='.tmp') as folder:
        temporary = Path(folder) / path.name
        with open(temporary, 'wb', opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Write the entries of a directory through to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
