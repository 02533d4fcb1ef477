# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Models of files with the same content share their numbers, as long as somebody holds them."""

import gc
from pathlib import Path
import shutil
import weakref

import pytest

from koopman_ros.lifting import load_shared, load_with_digest, ModelFileError
from koopman_ros.resources import model_path


def test_equal_files_are_one_model_in_memory(tmp_path: Path) -> None:
    for name in ('a', 'b'):
        shutil.copy(model_path('reactor_nz4'), tmp_path / f'{name}.safetensors')
    first, digest = load_shared(tmp_path / 'a.safetensors')
    second, same = load_shared(tmp_path / 'b.safetensors')
    assert first.training_states is second.training_states
    assert all(mine is theirs for mine, theirs in zip(
        (first.A, first.B, first.observables), (second.A, second.B, second.observables),
        strict=True))
    # what is derived is each one's own
    assert first is not second
    assert first.layout is not second.layout
    assert same == digest
    assert digest == load_with_digest(tmp_path / 'a.safetensors')[1]


def test_file_that_was_replaced_is_another_model(tmp_path: Path) -> None:
    path = tmp_path / 'a.safetensors'
    shutil.copy(model_path('reactor_nz4'), path)
    first, _ = load_shared(path)
    shutil.copy(model_path('reactor_nz3'), path)
    assert load_shared(path)[0].n_z == 3
    assert first.n_z == 4
    path.write_bytes(b'')
    with pytest.raises(ModelFileError):
        load_shared(path)


def test_model_that_nobody_holds_is_dropped() -> None:
    model, _ = load_shared(model_path('two_tanks'))
    held = weakref.ref(model)
    del model
    gc.collect()
    assert held() is None
