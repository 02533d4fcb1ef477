# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The model file: bit for bit there and back, one sentence for whatever is wrong with it."""

from collections.abc import Callable
from dataclasses import replace
import hashlib
import importlib
import json
import os
from pathlib import Path
import resource
import stat
import threading
import time
from typing import Any, TypeAlias

import numpy as np
import pytest

from koopman_ros.lifting import (
    artefact,
    LiftedModel,
    linearised_model,
    load,
    ModelFileError,
    NetworkObservables,
    PolynomialObservables,
    save,
    TrainingStates,
)
from koopman_ros.lifting.bounds import read_regular
from support.closed_loops import content
from support.random_lifts import random_lift

Change: TypeAlias = tuple[Callable[[bytes], bytes], str]
SHIPPED = Path(__file__).parents[2] / 'config' / 'models'

MODELS = {
    'one layer': random_lift(),
    'two layers': random_lift(3, (5, 4), n_u=2),
    'free': random_lift(1, (3,), identity=False, n_free=2),
    'sigmoid': random_lift(2, (5, 4), activation='sigmoid'),
    'sine': random_lift(activation='sine'),
    'softplus': random_lift(1, activation='softplus'),
    'with training states': replace(random_lift(), training_states=TrainingStates.of(
        np.random.default_rng(0).normal(size=(300, 2)), np.ones(2))),
    'untrained': replace(
        random_lift(), provenance=replace(random_lift().provenance, seed=None, metrics={})),
    'linear': linearised_model(
        np.diag([-1.0, -2.0]), np.ones((2, 1)), random_lift().states, random_lift().inputs, 's',
        random_lift().provenance),
}


def arrays(model: LiftedModel) -> dict[str, np.ndarray]:
    """Name the arrays of a model as its file does."""
    network = model.observables
    assert isinstance(network, NetworkObservables)
    named = {'A': model.A, 'B': model.B, 'output': network.output}
    if model.training_states is not None:
        named['training_states'] = model.training_states.states
    for i, (weight, bias) in enumerate(network.hidden):
        named[f'hidden.{i}.weight'] = weight
        named[f'hidden.{i}.bias'] = bias
    return named


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'model.safetensors'


@pytest.fixture
def sound(path: Path) -> bytes:
    """Return the bytes of a sound file, which also lies at `path`."""
    save(MODELS['one layer'], path)
    return path.read_bytes()


def split(content: bytes) -> tuple[dict[str, Any], bytes]:
    length = int.from_bytes(content[:8], 'little')
    return json.loads(content[8:8 + length]), content[8 + length:]


def joined(header: bytes, data: bytes) -> bytes:
    return len(header).to_bytes(8, 'little') + header + data


def refusal(path: Path, content: bytes) -> str:
    """Write `content` and return the sentence with which it is refused."""
    path.write_bytes(content)
    with pytest.raises(ModelFileError) as caught:
        load(path)
    message = str(caught.value)
    assert '\n' not in message
    assert str(path) in message
    return message


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
def test_round_trip_is_exact(model, path):
    safetensors = importlib.import_module('safetensors.numpy')
    save(model, path)
    first = path.read_bytes()
    assert content(load(path)) == content(model)
    # the same model gives the same bytes
    save(load(path), path)
    assert path.read_bytes() == first
    # the official library reads the same arrays
    read = safetensors.load_file(path)
    assert {name: content(array) for name, array in read.items()} == {
        name: content(array) for name, array in arrays(model).items()}
    # which are aligned to eight bytes
    header, data = split(first)
    assert (len(first) - len(data)) % 8 == 0
    assert all(entry['data_offsets'][0] % 8 == 0
               for key, entry in header.items() if key != '__metadata__')


@pytest.mark.parametrize('shipped', sorted(SHIPPED.glob('*.safetensors')), ids=lambda p: p.stem)
def test_a_shipped_file_is_written_again_bit_for_bit(shipped, path):
    save(load(shipped), path)
    assert path.read_bytes() == shipped.read_bytes()


def test_a_dictionary_has_no_file(path):
    dictionary = replace(MODELS['one layer'],
                         observables=PolynomialObservables.total_degree(2, 2))
    with pytest.raises(
            TypeError, match='only network lifts can be saved, got PolynomialObservables'):
        save(dictionary, path)
    assert not path.exists()


def test_extreme_values_survive(path):
    A = np.diag([5e-324, -0.0, np.finfo(float).max, np.pi, -np.finfo(float).tiny])
    save(replace(MODELS['one layer'], A=A), path)
    assert load(path).A.tobytes() == A.tobytes()


def test_a_file_rewritten_by_the_official_library_loads(path):
    safetensors = importlib.import_module('safetensors')
    numpy_format = importlib.import_module('safetensors.numpy')
    save(MODELS['two layers'], path)
    with safetensors.safe_open(path, framework='numpy') as file:
        metadata = file.metadata()
    assert (metadata['format'], metadata['format_version']) == ('koopman_ros.lift', '1')
    about = json.loads(metadata['description'])
    assert (about['n_x'], about['n_u'], about['n_z']) == (3, 2, 6)
    numpy_format.save_file(numpy_format.load_file(path), path, metadata=metadata)
    assert content(load(path)) == content(MODELS['two layers'])


def test_a_file_cut_off_anywhere_is_refused(path, sound):
    for length in (*range(200), *range(200, len(sound), 7), len(sound) - 1):
        assert 'cut off' in refusal(path, sound[:length]), length


@pytest.mark.parametrize(('foreign', 'words'), [
    (b'', 'only 0 bytes long'),
    (b'\x80\x02}q\x00.', 'only 6 bytes long'),
    (b'PK\x03\x04' + bytes(200), 'not a safetensors file'),
    (b'\x89HDF\r\n\x1a\n' + bytes(200), 'not a safetensors file'),
    (bytes(8), 'not a safetensors file'),
    (joined(b'{"A": ', b''), 'not a safetensors file'),
    (joined(b'[]', b''), 'not a safetensors file'),
    (joined(b'{}', b''), 'a safetensors file of something else'),
    (joined(b'\xff\xfe{}', b''), 'not a safetensors file'),
    (joined(b'[' * 100_000, b''), 'not a safetensors file'),
    (joined(b'{"A":' * 100_000, b''), 'not a safetensors file'),
    ((1 << 60).to_bytes(8, 'little') + bytes(64), 'not a safetensors file'),
])
def test_foreign_content_is_refused(path, foreign, words):
    assert words in refusal(path, foreign)


def test_a_missing_file_is_named(path):
    with pytest.raises(ModelFileError, match=f'^no model file at {path}: check the path'):
        load(path)


SPECIAL = {
    'a folder': Path.mkdir,
    'a named pipe': os.mkfifo,
    'a socket': lambda path: os.mknod(path, stat.S_IFSOCK | 0o600),
    'a device': lambda path: path.symlink_to('/dev/zero'),
}


@pytest.mark.parametrize('kind', SPECIAL)
def test_what_is_no_regular_file_is_not_read(path, kind):
    SPECIAL[kind](path)
    with pytest.raises(ModelFileError) as caught:
        load(path)
    assert str(caught.value) == (
        f'cannot read the model file {path}: it is {kind}, not a regular file')


def test_a_pipe_that_takes_the_place_of_a_file_is_not_waited_for(path, sound, monkeypatch):
    seen = os.stat(path)
    path.unlink()
    os.mkfifo(path)
    monkeypatch.setattr(os, 'stat', lambda *_: seen)
    with pytest.raises(ModelFileError, match='it is a named pipe, not a regular file'):
        load(path)


def test_a_file_without_an_end_is_read_up_to_the_limit(path, sound):
    assert read_regular(path, 100) == sound[:101]
    assert read_regular(path, len(sound)) == sound
    link = path.with_name('link.safetensors')
    link.symlink_to(path)
    assert content(load(link)) == content(MODELS['one layer'])


def test_a_file_far_too_large_is_not_read(path):
    with path.open('wb') as file:
        file.truncate(1 << 29)
    with pytest.raises(ModelFileError, match=f'it is more than {1 << 22} bytes long, far more'):
        load(path)


def header(change: Callable[[dict], object], words: str) -> Change:
    """Change the header of a file."""
    def changed(sound: bytes) -> bytes:
        found, data = split(sound)
        change(found)
        return joined(json.dumps(found).encode(), data)
    return changed, words


def entry(words: str, **changes: Any) -> Change:
    """Change what the header says of the array A."""
    return header(lambda h: h['A'].update(changes), words)


def about(change: Callable[[dict], object], words: str, sign: bool = False) -> Change:
    """Change the description of the model, with a checksum that is right where it is signed."""
    def changed(sound: bytes) -> bytes:
        found, data = split(sound)
        described = json.loads(found['__metadata__']['description'])
        change(described)
        return resigned(json.dumps(described), found, data, sign)
    return changed, words


def resigned(description: str, header: dict[str, Any], data: bytes, sign: bool = True) -> bytes:
    """Return a file with another description."""
    metadata = header.pop('__metadata__')
    metadata['description'] = description
    if sign:
        index = json.dumps(header, sort_keys=True).encode()
        metadata['sha256'] = hashlib.sha256(
            b'\0'.join((description.encode(), index, data))).hexdigest()
    return joined(json.dumps({'__metadata__': metadata, **header}).encode(), data)


def states(words: str, **changes: Any) -> Change:
    return about(lambda a: a['states'].update(changes), words)


def metadata(words: str, **changes: Any) -> Change:
    return header(lambda h: h['__metadata__'].update(changes), words)


def value(name: str, number: float) -> Change:
    """Change the last number of an array."""
    def changed(sound: bytes) -> bytes:
        found, data = split(sound)
        end = found[name]['data_offsets'][1]
        return sound[:len(sound) - len(data)] + (
            data[:end - 8] + np.float64(number).tobytes() + data[end:])
    return changed, (f'the array {name!r} holds values that are not finite'
                     if not np.isfinite(number) else 'checksum is wrong')


HUGE = 10 ** 400
MALFORMED = "the entry of the array 'A' is malformed"
INCONSISTENT = 'its content is inconsistent'
ELSE = 'a safetensors file of something else'
ACTIVATIONS = "activation must be one of 'tanh', 'sigmoid', 'sine', 'softplus', got "
COUNT = ' must be an integer of at least 0'

HOSTILE: dict[str, Change] = {
    'a byte more': (lambda sound: sound + b'\0', 'it has 1 bytes too many'),
    'a number more': (lambda sound: sound + bytes(8), 'it has 8 bytes too many'),
    **{f'{number} in {name}': value(name, number) for number in (np.nan, np.inf, -np.inf, 7.0)
       for name in ('A', 'B', 'output', 'hidden.0.weight', 'hidden.0.bias')},
    # The header.
    **{f'version {version!r}': metadata(
        f'has format version {version!r}, this package reads 1: retrain', format_version=version)
       for version in ('2', '0', '', '1.0', 1, None)},
    'wrong type': entry("the array 'A' has type 'F32', expected F64", dtype='F32'),
    'no type': header(lambda h: h['A'].pop('dtype'), MALFORMED),
    'no shape': header(lambda h: h['A'].pop('shape'), MALFORMED),
    'shape as text': entry(MALFORMED, shape='55'),
    'fraction in shape': entry(MALFORMED, shape=[5.5, 5]),
    'negative shape': entry(MALFORMED, shape=[-5, -5]),
    'infinite shape': entry(MALFORMED, shape=[float('inf'), 5]),
    'shape too large': entry(MALFORMED, shape=[0, HUGE], data_offsets=[0, 0]),
    'many dimensions': entry("'A' has 72 dimensions, expected at most 2", shape=[5, 5] + [1] * 70),
    'size and shape differ': entry("'A' of shape (5, 6) does not fit its 200 by", shape=[5, 6]),
    'start after end': entry('does not fit its -200 bytes', data_offsets=[200, 0]),
    'three offsets': entry(MALFORMED, data_offsets=[0, 100, 200]),
    'negative start': entry(MALFORMED, data_offsets=[-8, 192]),
    'one offset': entry('not a safetensors file', data_offsets=[0]),
    'infinite offset': entry('not a safetensors', data_offsets=[0, float('inf')]),
    'entry is no object': header(lambda h: h.update(A=None), 'not a safetensors file'),
    'offset beyond the end': header(lambda h: h['output'].update(data_offsets=[344, 464]),
                                    '8 bytes of its arrays are missing'),
    'wrong shape of A': entry('incompatible A: expected (5, 5), got (25,)', shape=[25]),
    'wrong shape of B': header(lambda h: h['B'].update(shape=[1, 2]),
                               'incompatible B: expected (2, 1), got (1, 2)'),
    'array under another name': header(lambda h: h.update(C=h.pop('B')),
                                       "expected the arrays ['A', 'B', 'hidden.0.bias'"),
    'missing array': header(lambda h: h.pop('B'),
                            "got ['A', 'hidden.0.bias', 'hidden.0.weight', 'output']"),
    'extra array': header(
        lambda h: h.update(C={'dtype': 'F64', 'shape': [1], 'data_offsets': [0, 8]}),
        "got ['A', 'B', 'C', 'hidden.0.bias', 'hidden.0.weight', 'output']"),
    'name twice': (lambda sound: joined(
        json.dumps(split(sound)[0]).replace('"dtype"', '"dtype": "", "dtype"', 1).encode(),
        split(sound)[1]), 'not a safetensors file'),
    'no metadata': header(lambda h: h.pop('__metadata__'), ELSE),
    'metadata is no object': header(lambda h: h.update(__metadata__=7), ELSE),
    'metadata of another': header(lambda h: h.update(__metadata__={'format': 'pt'}), ELSE),
    'no version': header(lambda h: h['__metadata__'].pop('format_version'), 'format version None'),
    'no description': header(
        lambda h: h['__metadata__'].pop('description'), "'description' is missing"),
    'description is a number': metadata(INCONSISTENT, description=3),
    'description is no JSON': metadata(INCONSISTENT, description='{n_x'),
    'description is a list': metadata(INCONSISTENT, description='[1]'),
    'description nests too deeply': metadata('recursion depth', description='[' * 100_000),
    # The description.
    'other activation': about(lambda a: a.update(activation='relu'), ACTIVATIONS + "'relu'"),
    'activation with a line break': about(
        lambda a: a.update(activation='a\nb'), ACTIVATIONS + r"'a\nb'"),
    'activation is a list': about(
        lambda a: a.update(activation=['tanh']), ACTIVATIONS + "['tanh']"),
    **{f'no {name}': about(lambda a, name=name: a.pop(name), f'{name!r} is missing')
       for name in ('activation', 'n_z', 'states', 'provenance')},
    'wrong n_x': about(lambda a: a.update(n_x=1), 'n_x is given as 1, the arrays say 2'),
    'wrong n_u': about(lambda a: a.update(n_u=2), 'n_u is given as 2, the arrays say 1'),
    'wrong n_z': about(lambda a: a.update(n_z=4), 'n_z is given as 4, the arrays say 5'),
    'n_z is text': about(lambda a: a.update(n_z='5'), f"n_z{COUNT}, got '5'"),
    'n_z is true': about(lambda a: a.update(n_z=True), f'n_z{COUNT}, got T'),
    'negative layers': about(lambda a: a.update(hidden_layers=-1), f'hidden_layers{COUNT}'),
    'two layers': about(lambda a: a.update(hidden_layers=2), "'hidden.1.bias'"),
    'ever so many layers': about(lambda a: a.update(hidden_layers=10 ** 15),
                                 '5 arrays cannot make up 1000000000000000 hidden layers'),
    'no layers': about(
        lambda a: a.update(hidden_layers=0), "expected the arrays ['A', 'B', 'output']"),
    'identity is a number': about(
        lambda a: a.update(identity=1), 'identity must be true or false'),
    'not identity': about(
        lambda a: a.update(identity=False), 'incompatible A: expected (3, 3), got (5, 5)'),
    'unknown time unit': about(
        lambda a: a.update(time_unit='h'), "must be 's' or 'min', got 'h'"),
    'states is a list': about(lambda a: a.update(states=[]), INCONSISTENT),
    'one unit too few': states('incompatible units: expected 2, got 1', units=['K']),
    'one state too few': states(
        'incompatible center: expected (1,), got (2,)', names=['T'], units=['K']),
    'center is null': states('center must be finite', center=[None, 1.0]),
    'center is ragged': states(INCONSISTENT, center=[[1], [1, 2]]),
    'center is an object': states(INCONSISTENT, center={'x': 1}),
    'center beyond floats': states(INCONSISTENT, center=[HUGE, 1]),
    'center is infinite': states('center must be finite', center=[float('inf'), 1]),
    'scale is zero': states('scale must be positive, got [0.0, 1.0]', scale=[0.0, 1.0]),
    'empty box': about(
        lambda a: a['inputs'].update(lower=[4.0]), 'the box is empty: lower [4.0]'),
    'seed is text': about(
        lambda a: a['provenance'].update(seed='1'), 'seed must be an integer'),
    **{f'metrics are {metrics!s:.20}': about(
        lambda a, metrics=metrics: a['provenance'].update(metrics=metrics), words)
       for metrics, words in (([], INCONSISTENT), ({'rw': HUGE}, INCONSISTENT), (
           {'rw': 'good'}, INCONSISTENT), (
           {'rw': float('nan')}, 'the metric rw is nan, not finite'))},
    'name twice in the description': (lambda sound: resigned(
        split(sound)[0]['__metadata__']['description'].replace('"n_u"', '"n_u": 1, "n_u"'),
        *split(sound)), 'a name comes twice'),
}

# What is told of a model in logs and messages.
UNTOLD = {
    'name that cannot be encoded': (
        {'names': ['x\ud800', 'x1']}, r"the name of a state = 'x\ud800' holds characters that"),
    'unit with a line break': ({'units': ['K', 'K\n']}, r"the unit of a state = 'K\n' holds"),
    'long name': ({'names': ['x' * 900_000, 'x1']},
                  'the name of a state has 900000 characters, at most 100 may be'),
    'name that is none': ({'names': [7, 'x1']}, 'the name of a state must be a text, got 7'),
    'digest that cannot be encoded': (
        {'provenance': {'data_digest': '\ud800'}}, r"data_digest = '\ud800' holds characters"),
    'plant that cannot be encoded': ({'provenance': {'plant': '\udfff'}}, 'plant = '),
    'plant is a list': ({'provenance': {'plant': ['a']}}, "plant must be a text, got ['a']"),
    'method with an escape': ({'provenance': {'method': '\x1b[2J'}}, r"method = '\x1b[2J' holds"),
    'long method': ({'provenance': {'method': 'm' * 201}}, 'at most 200 may be'),
    'version with a null': ({'provenance': {'package_version': '0\0'}}, 'package_version = '),
    'metric that cannot be encoded': (
        {'provenance': {'metrics': {'\ud800': 1.0}}}, 'the name of a metric = '),
    'metric that is not finite': (
        {'provenance': {'metrics': {'rw': np.nan}}}, 'the metric rw is nan, not finite'),
    'ever so many metrics': (
        {'provenance': {'metrics': {f'm{i}': 1.0 for i in range(101)}}},
        'there are 101 metrics, at most 100 may be'),
    'huge seed': ({'provenance': {'seed': HUGE}}, 'the seed must be an integer of at least 0'),
}


def told(changes: dict[str, Any], words: str) -> Change:
    def change(described: dict[str, Any]) -> None:
        described['provenance'].update(changes.get('provenance', {}))
        described['states'].update((name, changes[name]) for name in changes.keys() - {
            'provenance'})
    return about(change, words, sign=True)


@pytest.mark.parametrize('case', [*HOSTILE, *UNTOLD])
def test_what_does_not_fit_is_refused(path, sound, case):
    change, words = HOSTILE.get(case) or told(*UNTOLD[case])
    message = refusal(path, change(sound))
    assert words in message
    assert 'restore it from a backup, or train the model again' in message or (
        'version' in case and 'retrain the model' in message)
    message.encode()
    assert len(message) < 1000


@pytest.mark.parametrize(('change', 'words'), [
    (lambda a: a.pop('fill_distance'), 'expected the arrays'),
    *((lambda a, value=value: a.update(fill_distance=value), words) for value, words in (
        (-0.5, 'fill_distance must be finite'), (np.nan, 'fill_distance must be finite'),
        ('0', 'fill_distance must be a number'), (True, 'fill_distance must be a number'),
        (0.25, 'checksum')))])
def test_training_states_that_do_not_fit_are_refused(path, change, words):
    save(MODELS['with training states'], path)
    assert words in refusal(path, about(change, words)[0](path.read_bytes()))


@pytest.mark.parametrize('case', [name for name in UNTOLD if 'is ' not in name])
def test_what_cannot_be_told_is_not_written(path, sound, case):
    model, changes = MODELS['one layer'], dict(UNTOLD[case][0])
    origin = replace(model.provenance, **changes.pop('provenance', {}))
    states = replace(model.states, **{name: tuple(value) for name, value in changes.items()})
    with pytest.raises((TypeError, ValueError)):
        save(replace(model, states=states, provenance=origin), path)
    assert path.read_bytes() == sound
    assert os.listdir(path.parent) == [path.name]


def test_texts_of_other_alphabets_are_no_harm(path):
    model = MODELS['one layer']
    told = replace(model, states=replace(model.states, units=('\N{DEGREE SIGN}C', 'K')),
                   provenance=replace(model.provenance, plant='R\xfchrkessel \u53cd\u5fdc',
                                      method='m' * 200, seed=2 ** 128 - 1))
    save(told, path)
    assert content(load(path)) == content(told)


# Beyond what a control step can bear: built by hand, for `save` refuses them, too.
LARGE = {
    'n_z is 33, at most 32': random_lift(n_free=31),
    'n_x is 33, at most 32': random_lift(33, identity=False),
    'n_u is 33, at most 32': random_lift(n_u=33),
    'the number of hidden layers is 9, at most 8': random_lift(widths=(2,) * 9),
    'the number of weights is 300876, at most 262144': random_lift(widths=(500, 594)),
}


@pytest.mark.parametrize('words', LARGE)
def test_model_that_is_too_large_is_neither_written_nor_read(path, words, monkeypatch):
    with pytest.raises(ValueError, match=words):
        save(LARGE[words], path)
    assert not path.exists()
    with monkeypatch.context() as careless:
        careless.setattr(artefact, 'check_sizes', lambda _: None)
        save(LARGE[words], path)
    with pytest.raises(ModelFileError, match=f'its content is inconsistent .{words}|more than a'):
        load(path)


@pytest.mark.parametrize('model', [
    random_lift(n_free=30), random_lift(32, identity=False), random_lift(n_u=32),
    random_lift(widths=(2,) * 8), random_lift(widths=(500, 500))])
def test_model_of_the_largest_size_is_written_and_read(path, model):
    save(model, path)
    assert content(load(path)) == content(model)


@pytest.mark.parametrize('region', ['anywhere', 'header'])
def test_flipped_bits_are_refused(path, sound, region):
    rng = np.random.default_rng(12)
    end = len(sound) if region == 'anywhere' else 8 + int.from_bytes(sound[:8], 'little')
    for _ in range(300):
        damaged = bytearray(sound)
        for position in rng.choice(end, size=rng.integers(1, 4), replace=False):
            damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(ModelFileError) as caught:
            load(path)
        assert '\n' not in str(caught.value)


def test_a_failing_write_leaves_the_old_file(path, sound):
    model = random_lift(widths=(2000,))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError, match='File too large'):
            save(model, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == sound
    assert os.listdir(path.parent) == [path.name]
    save(model, path)
    assert content(load(path)) == content(model)


def test_a_failing_replacement_leaves_no_temporary(path):
    path.mkdir()
    with pytest.raises(IsADirectoryError):
        save(MODELS['one layer'], path)
    assert os.listdir(path.parent) == [path.name]
    assert os.listdir(path) == []


def test_a_missing_folder_is_not_made(tmp_path):
    with pytest.raises(FileNotFoundError):
        save(MODELS['one layer'], tmp_path / 'none' / 'model.safetensors')
    assert os.listdir(tmp_path) == []


def test_a_reader_sees_the_old_file_or_the_new_one(path):
    small, large = MODELS['one layer'], random_lift(widths=(2000,), seed=3)
    save(small, path)
    done = threading.Event()

    def alternate() -> None:
        while not done.is_set():
            save(large, path)
            save(small, path)

    writer = threading.Thread(target=alternate)
    writer.start()
    seen: list[int] = []
    deadline = time.monotonic() + 30.0
    try:
        while (len(seen) < 200 or len(set(seen)) < 2) and time.monotonic() < deadline:
            seen.append(arrays(load(path))['output'].shape[1])
    finally:
        done.set()
        writer.join()
    assert set(seen) == {5, 2000}


def test_the_file_has_the_usual_permissions(path, sound):
    usual = path.with_name('usual')
    usual.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(usual.stat().st_mode)
