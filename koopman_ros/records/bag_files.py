# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a bag, in reading order, of a recorder that ended well or was killed."""

import os
from pathlib import Path, PurePath
import re

from koopman_ros.core.yaml_text import load_yaml
from koopman_ros.records.mcap_file import BagReadError, is_closed, reason, RECOVER
from koopman_ros.records.metadata import METADATA_FILE, METADATA_KEY

# The files of a bag directory: run_0.mcap, run_1.mcap, ..., or the same compressed by rosbag2;
# with its pull request 2265 0_run_2025_12_17-10_00_00.mcap, 1_run_2025_12_17-10_05_00.mcap, ...
_COMPRESSED = '.zstd'
_NUMBERED = re.compile(r'(?:\d+_(?P<new>.*)_\d{4}_\d\d_\d\d-\d\d_\d\d_\d\d|(?P<old>.*)_\d+)'
                       r'\.mcap(?:\.zstd)?')
# Of metadata.yaml; one that lists ten thousand files has a fifth of it.
_MAX_METADATA_BYTES = 2**24


def locate(path: str | os.PathLike[str], *, recover: bool) -> tuple[tuple[Path, ...], bool]:
    """
    Return the files of a bag in the order of its metadata, and whether its recorder closed them.

    With `recover`, files without a footer pass, and a directory without metadata.yaml, or with
    numbered files that it does not list, is read in the order of the file numbers. Raises
    BagReadError for any other defect.
    """
    path = Path(path)
    if not path.exists():
        raise BagReadError(f'bag {str(path)!r} does not exist: check the path')
    files: tuple[Path, ...]
    if not path.is_dir():
        files, listed = (path,), True
    elif (path / METADATA_FILE).is_file():
        files, listed = _listed_files(path), True
        if left_behind := _left_behind(path, files):
            if not recover:
                raise BagReadError(
                    f'{str(left_behind[0])!r} is not listed in {METADATA_FILE}, because its '
                    f'recorder did not close it: {RECOVER}')
            files, listed = tuple(sorted({*files, *left_behind}, key=_natural_order)), False
    elif recover:
        files, listed = tuple(_files_with_content(path)), False
        if not files:
            raise BagReadError(f'{str(path)!r} has neither {METADATA_FILE} nor non-empty MCAP '
                               'files: check the path')
    else:
        raise BagReadError(f'{str(path)!r} has no {METADATA_FILE}: its recorder did not close it, '
                           f'or it is not a bag: {RECOVER}')
    closed = [is_closed(file) for file in files]
    if not all(closed) and not recover:
        unclosed = files[closed.index(False)]
        raise BagReadError(
            f'{str(unclosed)!r} was not closed by its recorder: {RECOVER}')
    return files, listed and all(closed)


def _listed_files(folder: Path) -> tuple[Path, ...]:
    """Return the files that metadata.yaml lists, in its order."""
    source = folder / METADATA_FILE
    try:
        if source.stat().st_size > _MAX_METADATA_BYTES:
            raise ValueError(f'more than {_MAX_METADATA_BYTES} bytes')
        information = load_yaml(source.read_text('utf-8'))[METADATA_KEY]
        compression = information.get('compression_format')
        # rosbag2 before version 4 lists them with the name of their folder
        names = [PurePath(name).name for name in information['relative_file_paths']]
        if not names or len(set(names)) < len(names) or '' in names:
            raise ValueError('no file, or a file twice')
        # `ros2 bag reindex` of Humble leaves it empty
        storage = information.get('storage_identifier') or (
            'sqlite3' if any('.db3' in name for name in names) else 'mcap')
        missing = [name for name in names if not (folder / name).is_file()]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BagReadError(
            f'{str(source)!r} is not the metadata of a bag ({reason(error)}): delete it and set '
            'recover to true to read the other files of the folder') from error
    if storage != 'mcap' or compression not in (None, '', 'none', 'zstd'):
        kind = f'{storage} files' + (f' compressed with {compression}' if compression else '')
        raise BagReadError(
            f'{str(folder)!r} holds {kind}, but only MCAP is supported, plain or compressed with '
            "zstd: convert it with 'ros2 bag convert'")
    if missing:
        raise BagReadError(
            f'{str(source)!r} lists {missing[0]!r}, which is missing: restore it')
    return tuple(folder / name for name in names)


def _left_behind(folder: Path, listed: tuple[Path, ...]) -> list[Path]:
    """Return the numbered files with content that metadata.yaml does not list, or not yet."""
    names = {_name_of_bag(file) for file in listed} - {None}
    known = {_plain_name(file) for file in listed}
    return [file for file in _files_with_content(folder)
            if _name_of_bag(file) in names and _plain_name(file) not in known]


def _name_of_bag(file: Path) -> str | None:
    """Return the part that the names of a bag's files share, None for a file without number."""
    match = _NUMBERED.fullmatch(file.name)
    return None if match is None else match['old'] if match['new'] is None else match['new']


def _files_with_content(folder: Path) -> list[Path]:
    """Return the MCAP files of a directory in the order of their numbers, each once."""
    # of a plain file and its compressed copy, the plain one: it was there before
    found = {_plain_name(file): file for pattern in (f'*.mcap{_COMPRESSED}', '*.mcap')
             for file in folder.glob(pattern) if file.is_file() and file.stat().st_size > 0}
    return sorted(found.values(), key=_natural_order)


def _plain_name(file: Path) -> str:
    return file.name.removesuffix(_COMPRESSED)


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Return a key that sorts 'run_2' before 'run_10'."""
    return [(int(part), '') if part.isdigit() else (-1, part)
            for part in re.split(r'(\d+)', file.name)]
