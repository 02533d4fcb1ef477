# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The model file: bit for bit there and back, and a rejection for everything else."""

from dataclasses import replace
import hashlib
import json
import os
from pathlib import Path
import resource
import stat
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.model import (
    InputTerms,
    linearised_model,
    load,
    load_with_digest,
    model_file,
    ModelFileError,
    PolynomialObservables,
    RateBand,
    save,
    TrainingStates,
    VerifiedLoops,
)
from support.closed_loops import content
from support.random_lifts import random_lift

SHIPPED = Path(__file__).parents[2] / 'config' / 'models'
RNG = np.random.default_rng(0)


def with_origin(**changes):
    model = random_lift()
    return replace(model, provenance=replace(model.provenance, **changes))


PLAIN = random_lift()
MODELS = {
    'network': PLAIN,
    'free': random_lift(1, 3, identity=False, n_free=2),
    'no inputs': random_lift(n_u=0),
    'training states': replace(PLAIN, training_states=TrainingStates.of(
        RNG.normal(size=(300, 2)), np.ones(2))),
    'read-out': replace(PLAIN, readout=RNG.normal(size=(2, 7))),
    'pre-feedback': replace(random_lift(n_u=2), pre_feedback=RNG.normal(size=(2, 2))),
    'input terms': replace(PLAIN, input_terms=InputTerms(RNG.normal(size=(5, 2, 1)))),
    'band of the rate': replace(PLAIN, rate_band=RateBand(
        np.full(PLAIN.n_x, 0.1), *(np.full((3, PLAIN.n_x), k) for k in (0.5, 1.0, 0.9, 1.1)))),
    'tried loops': replace(PLAIN, verified_loops=VerifiedLoops(
        *RNG.normal(size=(2, 7, 2)), np.arange(7) % 3 == 0)),
    'rejected': with_origin(model_class='neural drift', accepted=False,
                           reasons=('too large', 'too few')),
    'accepted': with_origin(accepted=True, reasons=('error 0.2 K',)),
    'monomials': replace(PLAIN, observables=PolynomialObservables.total_degree(2, 2),
                         readout=RNG.normal(size=(2, 5))),
    'extreme': replace(PLAIN, A=np.diag(
        [5e-324, -0.0, 1e9, np.pi, -np.finfo(float).tiny])),
    'other alphabets': replace(
        with_origin(plant='R\xfchrkessel \u53cd\u5fdc', method='m' * 200, seed=2 ** 128 - 1),
        states=replace(PLAIN.states, units=('\N{DEGREE SIGN}C', 'K'))),
    'untrained': with_origin(seed=None, metrics={}),
    'dead time': replace(random_lift(n_u=2), dead_time=np.array([0.0, 12.3])),
    'measured': replace(PLAIN, states_measured=('x1',)),
    'disturbances': random_lift(n_u=3).with_disturbances(('u2', 'u0')),
    'characteristic': replace(PLAIN, inputs=replace(PLAIN.inputs, characteristics={
        PLAIN.inputs.names[0]: Characteristic.of([-1.0, 0.1, 2.0], [0.0, 0.7, 1.0])})),
    'largest': random_lift(32, 32, identity=False, n_free=32, n_u=32),
    'linear': linearised_model(np.diag([-1.0, -2.0]), np.ones((2, 1)), PLAIN.states,
                               PLAIN.inputs, 's', PLAIN.provenance),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'model.safetensors'


@pytest.fixture
def sound(path: Path) -> bytes:
    """Return the bytes of a sound file, which also lies at `path`."""
    save(PLAIN, path)
    return path.read_bytes()


def rejection(path: Path, file: bytes) -> str:
    """Write a file and return the message of its rejection."""
    path.write_bytes(file)
    with pytest.raises(ModelFileError) as caught:
        load(path)
    message = str(caught.value)
    assert message.isprintable()
    assert str(path) in message
    assert 'restore it from a backup, or train the model again' in message
    assert len(message) < 1000
    return message


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
def test_round_trip_is_exact(model, path):
    save(model, path)
    first = path.read_bytes()
    assert content(load(path)) == content(model)
    # the same model gives the same bytes
    save(load(path), path)
    assert path.read_bytes() == first
    usual = path.with_name('usual')
    usual.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(usual.stat().st_mode)


def test_a_shipped_file_is_written_again_bit_for_bit(path):
    for shipped in SHIPPED.glob('*.safetensors'):
        save(load(shipped), path)
        assert path.read_bytes() == shipped.read_bytes(), shipped


def test_the_digest_is_that_of_the_file(path, sound):
    assert load_with_digest(path)[1] == hashlib.sha256(sound).hexdigest()


# What is no model file.

@pytest.mark.parametrize(('make', 'words'), [
    (lambda path: None, 'no model file at'),
    (Path.mkdir, 'not a regular file'), (os.mkfifo, 'not a regular file'),
    (lambda path: path.symlink_to('/dev/zero'), 'not a regular file'),
    (lambda path: path.touch() or os.truncate(path, 1 << 29), 'more than 4194304 bytes')])
def test_anything_but_a_regular_file_of_a_fair_size_is_not_read(path, make, words):
    make(path)
    with pytest.raises(ModelFileError, match=words) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize('foreign', [
    b'', b'\x80\x02}q\x00.', b'PK\x03\x04' + bytes(200), bytes(8), b'[' * 10_000,
    *(len(header).to_bytes(8, 'little') + header for header in (
        b'{}', b'[]', b'{"A": ', b'\xff\xfe{}', b'[' * 100_000, b'{"A":' * 100_000,
        b'{"__metadata__":{"format":"pt"}}')),
    (1 << 60).to_bytes(8, 'little') + bytes(64)])
def test_foreign_content_is_rejected(path, foreign):
    rejection(path, foreign)


def test_a_file_cut_off_longer_or_with_flipped_bits_is_rejected(path, sound):
    rng = np.random.default_rng(12)
    for length in (*range(0, len(sound), 9), len(sound) - 1):
        rejection(path, sound[:length])
    rejection(path, sound + b'\0')
    # half of them in the header
    for end in [len(sound), 8 + int.from_bytes(sound[:8], 'little')] * 200:
        damaged = bytearray(sound)
        for position in rng.choice(end, size=rng.integers(1, 4), replace=False):
            damaged[position] ^= 1 << int(rng.integers(8))
        rejection(path, bytes(damaged))


# A file in the right format whose checksum is right, too.

def changed(file: bytes, about: Any = None, **tensors: Any) -> bytes:
    """Return a file with a changed description or other arrays, None for none."""
    length = 8 + int.from_bytes(file[:8], 'little')
    metadata = json.loads(json.loads(file[8:length])['__metadata__'][model_file._KEY])
    arrays = safetensors.numpy.load(file) | tensors
    arrays = {name: value for name, value in arrays.items() if value is not None}
    if about is not None:
        about(metadata['model'])
    metadata['sha256'] = model_file._checksum(metadata['model'], arrays)
    return safetensors.numpy.save(
        arrays, metadata={model_file._KEY: json.dumps(metadata)})


HUGE, INFINITE = 10 ** 400, float('inf')
# Changes of a part of the description, and words of the rejection.
DESCRIPTIONS: list[tuple[str, dict[str, Any], str]] = [
    ('', {'identity': 1}, 'identity must be a bool'), ('', {'identity': False}, 'incompatible A'),
    *(('', {'dead_time': value}, words) for value, words in (
        (3.0, 'dead_time must be a list'), ([1.0, 2.0], 'incompatible dead_time'),
        ([-0.1], 'dead time of u0 must be 0 to 3600 s'), ([9e4], 'got 90000 s'),
        ([INFINITE], 'dead_time must be finite'), ([None], ''))),
    ('', {'states_measured': 'x0'}, 'states_measured must be a list'),
    ('', {'states_measured': ['x1', 'x0']}, 'each once and in this order'),
    ('', {'disturbances': []}, ''), ('', {'disturbances': {}}, "'names' is missing"),
    ('', {'time_unit': 'h'}, 'time_unit'), ('', {'states': []}, ''), ('', {'provenance': 3}, ''),
    ('states', {'units': ['K']}, 'incompatible units'),
    ('states', {'names': ['T'], 'units': ['K']}, 'incompatible center'),
    ('states', {'names': 'xy'}, 'names must be a list'),
    *(('states', {'center': center}, '') for center in (
        [None, 1.0], [INFINITE, 1], [[1], [1, 2]], {'x': 1}, [HUGE, 1], [[1, 2], [3, 4]])),
    ('states', {'scale': [0.0, 1.0]}, 'scale must be positive'),
    ('states', {'scale': [1.0, 1e-300]}, '1 / scale[x1] is 1e+300, allowed are'),
    ('states', {'center': [1.0, -1e200]}, 'center[x1] is -1e+200, allowed are'),
    ('inputs', {'upper': [1e300]}, 'upper[u0] is 1e+300, allowed are'),
    ('inputs', {'characteristics': {'u0': [[0.0, 1e300], [0.0, 1e300]]}}, 'characteristic[u0] is'),
    ('inputs', {'lower': [4.0]}, 'the box is empty'),
    ('states', {'names': ['x\ud800', 'x1']}, 'unprintable'),
    ('states', {'units': ['K', 'K\n']}, 'unprintable'),
    ('states', {'units': ['K', 'm" :title="(alert(1))" a="']}, 'no unit'),
    ('states', {'units': ['K', 'm # a']}, 'no unit'),
    ('states', {'units': ['9**9**9', 'K']}, 'no unit'),
    ('states', {'names': ['x' * 900_000, 'x1']}, 'maximum is 100'),
    ('states', {'names': [7, 'x1']}, 'must be a string'),
    *(('provenance', change, word) for change, word in (
        ({'seed': '1'}, 'seed'), ({'seed': -1}, 'seed'), ({'seed': True}, 'seed'),
        ({'seed': HUGE}, 'seed'), ({'metrics': []}, ''), ({'metrics': {'rw': HUGE}}, ''),
        ({'metrics': {'rw': 'good'}}, ''), ({'metrics': {'rw': np.nan}}, 'not finite'),
        ({'metrics': {'\ud800': 1.0}}, 'unprintable'),
        ({'metrics': {f'm{i}': 1.0 for i in range(101)}}, 'maximum is 100'),
        ({'data_digest': '\ud800'}, 'unprintable'), ({'plant': ['a']}, 'must be a string'),
        ({'method': '\x1b[2J'}, 'unprintable'), ({'method': 'm' * 4001}, 'maximum is 4000'),
        ({'package_version': '0\0'}, 'unprintable'), ({'magic': 1}, 'magic'),
        ({'model_class': 'magic'}, 'model_class must be one of'),
        ({'accepted': 'yes'}, 'accepted must be a bool'), ({'accepted': False}, 'reasons'),
        ({'reasons': ['too large']}, 'reasons'), ({'accepted': False, 'reasons': 'x'}, 'list'),
        ({'accepted': False, 'reasons': ['a\nb']}, 'unprintable')))]


def with_one(values, number):
    changed = values.copy()
    changed[1, min(1, values.shape[1] - 1)] = number
    return changed


ARRAYS: list[tuple[str, dict[str, Any], str]] = [
    *(('network', {name: np.full_like(value, number)}, 'must be finite')
      for number in (np.nan, np.inf)
      for name, value in (('A', PLAIN.A), ('B', PLAIN.B), ('W', PLAIN.observables.W),
                          ('b', PLAIN.observables.b), ('V', PLAIN.observables.V))),
    *((name, {array: with_one(value, 1e9 * (1.0 + 1e-9))}, f'{place}] is 1e+09')
      for name, array, value, place in (
          ('network', 'W', PLAIN.observables.W, 'W[1, x1'), ('network', 'A', PLAIN.A, 'A[1, 1'),
          ('read-out', 'readout', MODELS['read-out'].readout, 'readout[x1, 1'),
          ('training states', 'training_states', MODELS['training states'].training_states.states,
           'training_states[1, x1'))),
    ('network', {'B': with_one(PLAIN.B, -1e300)}, 'B[x1, u0] is -1e+300, allowed are -1e+09 to'),
    ('network', {'A': PLAIN.A.astype(np.float32)}, 'has type float32'),
    ('network', {'A': PLAIN.A.ravel()}, 'incompatible A'),
    ('network', {'B': PLAIN.B.T}, 'incompatible B'),
    ('network', {'B': None}, "'B' is missing"), ('network', {'W': None}, "'W' is missing"),
    ('network', {'C': np.ones(1)}, 'unknown arrays: C'),
    ('training states', {'training_states': np.zeros((257, 2))}, 'M from 1 to 256'),
    ('read-out', {'readout': np.zeros((7, 2))}, 'incompatible readout'),
    ('pre-feedback', {'pre_feedback': np.zeros((2, 3))}, 'incompatible pre_feedback'),
    ('disturbances', {'E': None}, 'incompatible E: expected (2, 2), got (2, 0)'),
    ('disturbances', {'E': np.full((2, 2), np.nan)}, 'E must be finite'),
    ('network', {'E': np.ones((2, 1))}, 'incompatible E: expected (2, 0)'),
    ('input terms', {'input_terms': np.zeros((4, 2, 1))}, 'incompatible input terms'),
    ('band of the rate', {'rate_band.lower': np.zeros((2, 2))}, 'rate_band.lower'),
    ('band of the rate', {'rate_band.upper': None}, 'rate_band.upper'),
    ('tried loops', {'verified_loops.lost': np.zeros(7)}, 'has type float64'),
    ('tried loops', {'verified_loops.lost': None}, 'lost'),
    ('monomials', {'exponents': np.eye(5, 2)}, 'has type float64'),
    ('monomials', {'exponents': -np.eye(5, 2, dtype=np.int64)}, 'at least 0'),
    ('monomials', {'exponents': np.array([[1, 0], [0, 1], [33, 0], [1, 1], [2, 0]])},
     'the degree is 33'),
]


@pytest.mark.parametrize(('part', 'changes', 'words'), DESCRIPTIONS, ids=lambda value: (
    f'{value!a:.60}'))
def test_a_description_that_does_not_fit_is_rejected(path, sound, part, changes, words):
    assert words in rejection(path, changed(sound, lambda about: (
        about[part] if part else about).update(changes)))


@pytest.mark.parametrize('name', ['identity', 'inputs', 'provenance', 'states', 'time_unit'])
def test_a_description_without_an_entry_is_rejected(path, sound, name):
    assert f'{name!r} is missing' in rejection(path, changed(sound, lambda about: about.pop(name)))


@pytest.mark.parametrize('fill', [-0.5, np.nan, '0', None])
def test_a_fill_distance_that_does_not_fit_is_rejected(path, fill):
    save(MODELS['training states'], path)
    assert 'fill_distance' in rejection(path, changed(
        path.read_bytes(), lambda about: about.update(fill_distance=fill)))


@pytest.mark.parametrize(('name', 'arrays', 'words'), ARRAYS)
def test_arrays_that_do_not_fit_are_rejected(path, name, arrays, words):
    save(MODELS[name], path)
    assert words in rejection(path, changed(path.read_bytes(), **arrays))


@pytest.mark.parametrize(('metadata', 'words'), [
    ('{"format_version": 2}', 'format version 2, this package reads 1'),
    ('{}', "'format_version' is missing"), ('[1]', ''), ('{n_x', ''), ('[' * 100_000, '')])
def test_metadata_of_another_format_is_rejected(path, sound, metadata, words):
    assert words in rejection(path, safetensors.numpy.save(
        safetensors.numpy.load(sound), metadata={model_file._KEY: metadata}))


LARGE = {
    'n_z is 33': random_lift(n_free=31),
    'n_x is 33': random_lift(33, identity=False),
    'n_u is 33': random_lift(n_u=33),
    'must be a string': with_origin(plant=3),
    'unprintable': with_origin(method='a\nb'),
    'not finite': with_origin(metrics={'rw': np.inf}),
}


@pytest.mark.parametrize('words', LARGE)
def test_a_model_beyond_the_limits_is_neither_written_nor_read(path, words, monkeypatch):
    with pytest.raises((TypeError, ValueError), match=words):
        save(LARGE[words], path)
    assert not path.exists()
    if words != 'not finite':
        with monkeypatch.context() as careless:
            careless.setattr(model_file, 'check', lambda _: None)
            save(LARGE[words], path)
        assert words in rejection(path, path.read_bytes())


def test_a_lift_of_another_kind_is_not_written(path):
    other = SimpleNamespace(n_x=2, n_z=5, identity=True, features=SimpleNamespace(n_z=5))
    with pytest.raises(TypeError, match='only lifts of networks and of monomials'):
        save(replace(PLAIN, observables=other), path)
    assert not path.exists()


# Writing.

def test_a_failing_write_leaves_the_old_file(path, sound):
    model = random_lift(units=2000)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError, match='File too large'):
            save(model, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == sound
    with pytest.raises(FileNotFoundError):
        save(model, path.with_name('none') / 'model.safetensors')
    assert os.listdir(path.parent) == [path.name]


def test_a_reader_sees_the_old_file_or_the_new_one(path, sound, monkeypatch):
    replaced, seen = os.replace, []

    def replace_in_sight(source: str, target: Path) -> None:
        seen.extend((content(load(source)), content(load(target))))
        replaced(source, target)

    monkeypatch.setattr(os, 'replace', replace_in_sight)
    large = random_lift(units=2000, seed=3)
    save(large, path)
    assert seen == [content(large), content(PLAIN)]
    assert content(load(path)) == content(large)
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize(('model', 'kind', 'acceptance'), [
    (with_origin(model_class='neural drift'), 'neural drift', 'not tested'),
    (MODELS['network'], 'identity lift, n_z = 5', 'not tested'),
    (MODELS['free'], 'free lift, n_z = 2', 'not tested'),
    (MODELS['monomials'], 'polynomial', 'not tested'),
    (MODELS['linear'], 'linear', 'not tested'),
    (MODELS['accepted'], 'identity lift, n_z = 5', 'accepted (error 0.2 K)'),
    (MODELS['rejected'], 'neural drift', 'rejected (too large; too few)')])
def test_class_and_acceptance_are_named(model, kind, acceptance, path):
    save(model, path)
    assert (load(path).kind, load(path).provenance.acceptance) == (kind, acceptance)
