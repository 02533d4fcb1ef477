# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models by the digest of their file, wherever that lies."""

from collections.abc import Iterator, Sequence
import contextlib
from pathlib import Path

from koopman_ros.lifting import LiftedModel, load_with_digest, ModelFileError
from koopman_ros.replay.records import RecordError


class Models:
    """
    Models by the digest of their file.

    :param places: files, and folders of which all model files count.
    """

    def __init__(self, places: Sequence[Path]) -> None:
        self._places = places

    def find(self, name: str, digest: str) -> LiftedModel:
        """
        Return a model, read anew.

        :param name: by which the controller knew it; looked up first where it is a path.
        :param digest: SHA-256 of its file.
        :raises RecordError: where there is none with this digest.
        """
        for path in self._files(name):
            with contextlib.suppress(ModelFileError, OSError):
                model, found = load_with_digest(path)
                if found == digest:
                    return model
        raise RecordError(
            f'the controller ran with the model {name} (SHA-256 {digest[:12]}...), which is '
            'neither shipped nor found: give its file, or the folder it is in, as model')

    def _files(self, name: str) -> Iterator[Path]:
        if name.endswith('.safetensors'):
            yield Path(name).expanduser()
        for place in self._places:
            yield from sorted(place.glob('*.safetensors')) if place.is_dir() else (place,)
