# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models of files with the same content, whose numbers are in memory once."""

import copy
from dataclasses import fields
import os
import threading
from weakref import WeakValueDictionary

from koopman_ros.lifting.artefact import load_with_digest
from koopman_ros.lifting.model import LiftedModel

_lock = threading.Lock()
_models: WeakValueDictionary[str, LiftedModel] = WeakValueDictionary()


def load_shared(path: str | os.PathLike[str]) -> tuple[LiftedModel, str]:
    """
    Read a model with its digest, as :func:`load_with_digest`; equal contents share their arrays.

    What a model derives from them is its own. What nobody holds is dropped.
    """
    model, digest = load_with_digest(path)
    with _lock:
        held = _models.setdefault(digest, model)
    return model if held is model else _twin(held), digest


def _twin(model: LiftedModel) -> LiftedModel:
    """Return another model of the same arrays."""
    twin = copy.copy(model)
    names = {field.name for field in fields(model)}
    for name in set(vars(twin)) - names:
        del vars(twin)[name]
    return twin
