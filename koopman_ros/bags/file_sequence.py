# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a bag being written, one after the other, and the metadata that lists them."""

from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from koopman_ros.bags.mcap_file import McapFile
from koopman_ros.bags.metadata import (
    bag_metadata,
    RecordedFile,
    RecordedTopic,
    sync_folder,
    write_metadata_file,
)


class FileSequence:
    """
    A file, or the directory of files `<name>_0.mcap`, `<name>_1.mcap`, ... with metadata.yaml.

    A file that has reached `max_bytes`, or `max_ns` [ns] of log time, is full. `metadata.yaml`
    lists the files that are complete and on the disk: whatever happens later, those can be read.
    Raises FileExistsError for a path that exists.
    """

    def __init__(
        self,
        path: Path,
        compression: str,
        custom_data: Mapping[str, str],
        max_bytes: float,
        max_ns: float,
    ) -> None:
        self._path = path
        self._is_directory = path.suffix != '.mcap'
        self._compression = compression
        self._custom_data = custom_data
        self._max_bytes = max_bytes
        self._max_ns = max_ns
        self._completed: list[RecordedFile] = []
        # A thread of its own: to write a large file through to the disk takes longer than
        # messages can wait.
        self._background = ThreadPoolExecutor(max_workers=1, thread_name_prefix='bag')
        self._completion: Future[None] | None = None
        self.current = self._create()
        self._count = 1

    def is_full(self, log_time_ns: int) -> bool:
        """Tell whether a message at this time [ns] belongs into the next file."""
        range_ns = self.current.content.time_range_ns
        return range_ns is not None and (
            self.current.size_bytes >= self._max_bytes
            or log_time_ns - range_ns[0] >= self._max_ns)

    def split(self, topics: Iterable[RecordedTopic]) -> None:
        """Go on in the next file, and complete the present one meanwhile."""
        if self._completion is not None:
            # long done, unless files fill up faster than the disk takes them
            self._completion.result()
        following = self._open(self._count)
        for topic in topics:
            following.add_topic(topic)
        full, self.current = self.current, following
        self._count += 1
        self._completion = self._background.submit(self._complete, full)

    def raise_failures(self) -> None:
        """Raise what went wrong with a file that was completed in the background."""
        if self._completion is not None and self._completion.done():
            self._completion.result()

    def complete(self) -> None:
        """Complete all files."""
        self._background.shutdown()
        try:
            self.raise_failures()
        finally:
            self._complete(self.current)

    def _create(self) -> McapFile:
        """Create the first file, and its directory; both calls fail on whatever exists."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._is_directory:
                self._path.mkdir()
            return self._open(0)
        except FileExistsError as error:
            raise FileExistsError(
                f'{str(error.filename)!r} exists already and recordings are never overwritten: '
                'choose another name, or move the old one away') from error

    def _open(self, number: int) -> McapFile:
        path = (self._path / f'{self._path.name}_{number}.mcap' if self._is_directory
                else self._path)
        return McapFile(path, self._compression, self._custom_data)

    def _complete(self, file: McapFile) -> None:
        """Complete a file, and list it in the metadata of a bag directory."""
        file.close()
        self._completed.append(file.content)
        if self._is_directory:
            write_metadata_file(self._path, bag_metadata(self._completed, self._custom_data))
        else:
            sync_folder(self._path.parent)
