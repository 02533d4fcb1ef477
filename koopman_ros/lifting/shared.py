# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models of files with the same content, as one object."""

import os
import threading
from weakref import WeakValueDictionary

from koopman_ros.lifting.artefact import load_with_digest
from koopman_ros.lifting.model import LiftedModel

_lock = threading.Lock()
_models: WeakValueDictionary[str, LiftedModel] = WeakValueDictionary()


def load_shared(path: str | os.PathLike[str]) -> tuple[LiftedModel, str]:
    """
    Read a model with its digest, as :func:`load_with_digest`; one object for each content.

    A model is immutable, so that whoever holds it notices nothing; what nobody holds is dropped.
    """
    model, digest = load_with_digest(path)
    with _lock:
        return _models.setdefault(digest, model), digest
