# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The model file: bit for bit there and back, one sentence for whatever is wrong with it."""

from collections.abc import Callable
from dataclasses import replace
import hashlib
import json
import os
from pathlib import Path
import resource
import stat
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from koopman_ros.lifting import (
    bounds,
    linearised_model,
    load,
    ModelFileError,
    PolynomialObservables,
    save,
    TrainingStates,
    TriedLoops,
)
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
    'with a read-out': replace(random_lift(widths=(5, 4)), readout=np.random.default_rng(
        0).normal(size=(2, 6))),
    'with a pre-feedback': replace(random_lift(n_u=2), pre_feedback=np.random.default_rng(
        0).normal(size=(2, 2))),
    'with tried loops': replace(random_lift(), tried_loops=TriedLoops(
        *np.random.default_rng(0).normal(size=(2, 7, 2)), np.arange(7) % 3 == 0)),
    'refused': replace(random_lift(), provenance=replace(
        random_lift().provenance, model_class='neural drift', refused=('too large', 'too few'))),
    'monomials': replace(
        random_lift(), observables=PolynomialObservables.total_degree(2, 2),
        readout=np.random.default_rng(0).normal(size=(2, 5))),
    'extreme': replace(random_lift(), A=np.diag(
        [5e-324, -0.0, np.finfo(float).max, np.pi, -np.finfo(float).tiny])),
    'other alphabets': replace(
        random_lift(), states=replace(random_lift().states, units=('\N{DEGREE SIGN}C', 'K')),
        provenance=replace(random_lift().provenance, plant='R\xfchrkessel \u53cd\u5fdc',
                           method='m' * 200, seed=2 ** 128 - 1)),
    'untrained': replace(
        random_lift(), provenance=replace(random_lift().provenance, seed=None, metrics={})),
    # the largest that can be
    **{f'{number} largest': model for number, model in enumerate((
        random_lift(n_free=30), random_lift(32, identity=False), random_lift(n_u=32),
        random_lift(widths=(2,) * 8), random_lift(widths=(500, 500))))},
    'linear': linearised_model(
        np.diag([-1.0, -2.0]), np.ones((2, 1)), random_lift().states, random_lift().inputs, 's',
        random_lift().provenance),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / 'model.safetensors'


@pytest.fixture
def sound(path: Path) -> bytes:
    """Return the bytes of a sound file, which also lies at `path`."""
    save(MODELS['one layer'], path)
    return path.read_bytes()


def split(file: bytes) -> tuple[dict[str, Any], bytes]:
    length = int.from_bytes(file[:8], 'little')
    return json.loads(file[8:8 + length]), file[8 + length:]


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
    save(model, path)
    first = path.read_bytes()
    assert content(load(path)) == content(model)
    # the same model gives the same bytes
    save(load(path), path)
    assert path.read_bytes() == first
    usual = path.with_name('usual')
    usual.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(usual.stat().st_mode)
    # arrays are aligned to eight bytes
    header, data = split(first)
    assert (len(first) - len(data)) % 8 == 0
    metadata = header.pop('__metadata__')
    assert all(entry['data_offsets'][0] % 8 == 0 for entry in header.values())
    assert (metadata['format'], metadata['format_version']) == ('koopman_ros.lift', '1')
    # the official library reads the same
    save_file(load_file(path), path, metadata=metadata)
    assert content(load(path)) == content(model)


def test_a_shipped_file_is_written_again_bit_for_bit(path):
    for shipped in SHIPPED.glob('*.safetensors'):
        save(load(shipped), path)
        assert path.read_bytes() == shipped.read_bytes(), shipped
        path.unlink()


def test_a_lift_of_another_kind_is_not_written(path):
    other = SimpleNamespace(n_x=2, n_z=5, identity=True)
    with pytest.raises(
            TypeError, match='only lifts of networks and of monomials can be saved, got Simp'):
        save(replace(MODELS['one layer'], observables=other), path)
    assert not path.exists()


@pytest.mark.parametrize(('number', 'words'), [
    (0.5, 'exponents must be whole numbers from 0 to 32'), (-1.0, 'exponents must be at least 0'),
    (1e300, 'exponents must be whole numbers from 0 to 32'),
    (33.0, 'the degree is 33, at most 32 can be controlled with'),
    (1.0, 'the row [0, 1] of exponents comes 2 times'), (3.0, 'checksum')])
def test_monomials_that_do_not_fit_are_refused(path, number, words):
    save(MODELS['monomials'], path)
    assert words in refusal(path, value('exponents', number)[0](path.read_bytes()))


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


CANNOT = 'cannot read the model file {}: it is '


@pytest.mark.parametrize(('make', 'words'), [
    (lambda path: None, 'no model file at {}: check the path, or train a model'),
    (Path.mkdir, CANNOT + 'a folder, not a regular file'),
    (os.mkfifo, CANNOT + 'a named pipe, not a regular file'),
    (lambda path: os.mknod(path, stat.S_IFSOCK | 0o600), CANNOT + 'a socket, not a regular file'),
    (lambda path: path.symlink_to('/dev/zero'), CANNOT + 'a device, not a regular file'),
    (lambda path: path.touch() or os.truncate(path, 1 << 29),
     '{} is not a usable model file: it is more than 4194304 bytes long, far more than any lift; '
     'restore it from a backup, or train the model again'),
])
def test_what_is_no_regular_file_of_a_fair_size_is_not_read(path, make, words):
    make(path)
    with pytest.raises(ModelFileError) as caught:
        load(path)
    assert str(caught.value) == words.format(path)


def test_a_pipe_that_takes_the_place_of_a_file_is_not_waited_for(path, sound, monkeypatch):
    seen = os.stat(path)
    path.unlink()
    os.mkfifo(path)
    monkeypatch.setattr(os, 'stat', lambda *_: seen)
    with pytest.raises(ModelFileError, match='it is a named pipe, not a regular file'):
        load(path)


def test_a_file_without_an_end_is_read_up_to_the_limit(path, sound):
    assert bounds.read_regular(path, 100) == sound[:101]
    assert bounds.read_regular(path, len(sound)) == sound
    link = path.with_name('link.safetensors')
    link.symlink_to(path)
    assert content(load(link)) == content(MODELS['one layer'])


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
        description = json.loads(found['__metadata__']['description'])
        change(description)
        return resigned(json.dumps(description), found, data, sign)
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


def described(words: str, **changes: Any) -> Change:
    return about(lambda a: a.update(changes), words)


def states(words: str, **changes: Any) -> Change:
    return about(lambda a: a['states'].update(changes), words)


def origin(words: str, **changes: Any) -> Change:
    return about(lambda a: a['provenance'].update(changes), words)


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
INFINITE = float('inf')
MALFORMED = "the entry of the array 'A' is malformed"
FOREIGN = 'not a safetensors file'
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
    **{f'no {name}': header(lambda h, name=name: h['A'].pop(name), MALFORMED)
       for name in ('dtype', 'shape')},
    **{f'A with {changes!s:.50}': entry(MALFORMED, **changes) for changes in (
        {'shape': '55'}, {'shape': [5.5, 5]}, {'shape': [-5, -5]}, {'shape': [INFINITE, 5]},
        {'shape': [0, HUGE], 'data_offsets': [0, 0]}, {'data_offsets': [0, 100, 200]},
        {'data_offsets': [-8, 192]})},
    'many dimensions': entry("'A' has 72 dimensions, expected at most 2", shape=[5, 5] + [1] * 70),
    'size and shape differ': entry("'A' of shape (5, 6) does not fit its 200 by", shape=[5, 6]),
    'start after end': entry('does not fit its -200 bytes', data_offsets=[200, 0]),
    'one offset': entry(FOREIGN, data_offsets=[0]),
    'infinite offset': entry(FOREIGN, data_offsets=[0, INFINITE]),
    'entry is no object': header(lambda h: h.update(A=None), FOREIGN),
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
        split(sound)[1]), FOREIGN),
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
    **{f'activation {name!r}': described(f'{ACTIVATIONS}{name!r}', activation=name)
       for name in ('relu', 'a\nb', ['tanh'])},
    **{f'no {name}': about(lambda a, name=name: a.pop(name), f'{name!r} is missing')
       for name in ('activation', 'n_z', 'states', 'provenance')},
    **{f'wrong {name}': described(f'{name} is given as {n}, the arrays say {actual}', **{name: n})
       for name, n, actual in (('n_x', 1, 2), ('n_u', 2, 1), ('n_z', 4, 5))},
    'n_z is text': described(f"n_z{COUNT}, got '5'", n_z='5'),
    'n_z is true': described(f'n_z{COUNT}, got T', n_z=True),
    'negative layers': described(f'hidden_layers{COUNT}', hidden_layers=-1),
    'two layers': described("'hidden.1.bias'", hidden_layers=2),
    'ever so many layers': described(
        '5 arrays cannot make up 1000000000000000 hidden layers', hidden_layers=10 ** 15),
    'no layers': described("expected the arrays ['A', 'B', 'output']", hidden_layers=0),
    'identity is a number': described('identity must be true or false', identity=1),
    'not identity': described('incompatible A: expected (3, 3), got (5, 5)', identity=False),
    'unknown time unit': described("must be 's' or 'min', got 'h'", time_unit='h'),
    'states is a list': described(INCONSISTENT, states=[]),
    'one unit too few': states('incompatible units: expected 2, got 1', units=['K']),
    'one state too few': states(
        'incompatible center: expected (1,), got (2,)', names=['T'], units=['K']),
    **{f'center {center!s:.20}': states(words, center=center) for center, words in (
        ([None, 1.0], 'center must be finite'), ([INFINITE, 1], 'center must be finite'),
        ([[1], [1, 2]], INCONSISTENT), ({'x': 1}, INCONSISTENT), ([HUGE, 1], INCONSISTENT))},
    'scale is zero': states('scale must be positive, got [0.0, 1.0]', scale=[0.0, 1.0]),
    'empty box': about(
        lambda a: a['inputs'].update(lower=[4.0]), 'the box is empty: lower [4.0]'),
    'seed is text': origin('seed must be an integer', seed='1'),
    **{f'metrics are {metrics!s:.20}': origin(words, metrics=metrics) for metrics, words in (
        ([], INCONSISTENT), ({'rw': HUGE}, INCONSISTENT), ({'rw': 'good'}, INCONSISTENT),
        ({'rw': np.nan}, 'the metric rw is nan, not finite'))},
    'name twice in the description': (lambda sound: resigned(
        split(sound)[0]['__metadata__']['description'].replace('"n_u"', '"n_u": 1, "n_u"'),
        *split(sound)), 'a name comes twice'),
}

# What is told of a model in logs and messages: part of the description, changes, words.
UNTOLD: dict[str, tuple[str, dict[str, Any], str]] = {
    'name that cannot be encoded': (
        'states', {'names': ['x\ud800', 'x1']},
        r"the name of a state = 'x\ud800' holds characters that"),
    'unit with a line break': (
        'states', {'units': ['K', 'K\n']}, r"the unit of a state = 'K\n' holds"),
    'long name': ('states', {'names': ['x' * 900_000, 'x1']},
                  'the name of a state has 900000 characters, at most 100 may be'),
    'name that is none': (
        'states', {'names': [7, 'x1']}, 'the name of a state must be a text, got 7'),
    **{name: ('provenance', changes, words) for name, changes, words in (
        ('digest that cannot be encoded', {'data_digest': '\ud800'},
         r"data_digest = '\ud800' holds characters"),
        ('plant that cannot be encoded', {'plant': '\udfff'}, 'plant = '),
        ('plant is a list', {'plant': ['a']}, "plant must be a text, got ['a']"),
        ('method with an escape', {'method': '\x1b[2J'}, r"method = '\x1b[2J' holds"),
        ('long method', {'method': 'm' * 201}, 'at most 200 may be'),
        ('version with a null', {'package_version': '0\0'}, 'package_version = '),
        ('metric that cannot be encoded', {'metrics': {'\ud800': 1.0}},
         'the name of a metric = '),
        ('metric that is not finite', {'metrics': {'rw': np.nan}},
         'the metric rw is nan, not finite'),
        ('ever so many metrics', {'metrics': {f'm{i}': 1.0 for i in range(101)}},
         'there are 101 metrics, at most 100 may be'),
        ('huge seed', {'seed': HUGE}, 'the seed must be an integer of at least 0'))},
}


@pytest.mark.parametrize('case', [*HOSTILE, *UNTOLD])
def test_what_does_not_fit_is_refused(path, sound, case):
    def tell(description: dict[str, Any]) -> None:
        part, changes, _ = UNTOLD[case]
        description[part].update(changes)

    change, words = HOSTILE.get(case) or about(tell, UNTOLD[case][-1], sign=True)
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


def test_a_read_out_that_does_not_fit_is_refused(path):
    save(MODELS['with a read-out'], path)
    sound = path.read_bytes()
    changes = (header(lambda h: h['readout'].update(shape=[6, 2]),
                      'incompatible readout: expected (2, 6), got (6, 2)'),
               value('readout', np.nan), value('readout', 7.0))
    for change, words in changes:
        assert words in refusal(path, change(sound))


def test_a_file_without_a_read_out_is_of_a_lift_read_by_its_rates(path, sound):
    assert 'readout' not in split(sound)[0]
    model, x = load(path), np.array([0.3, -0.2])
    z, J = model.lift_and_jacobian(x)
    np.testing.assert_allclose(model.drift(x), np.linalg.lstsq(J, model.A @ z)[0], rtol=1e-12)


@pytest.mark.parametrize('case', [name for name in UNTOLD if 'is ' not in name])
def test_what_cannot_be_told_is_not_written(path, sound, case):
    part, changes, _ = UNTOLD[case]
    model = MODELS['one layer']
    changed = {part: replace(getattr(model, part), **{
        name: tuple(value) if part == 'states' else value for name, value in changes.items()})}
    with pytest.raises((TypeError, ValueError)):
        save(replace(model, **changed), path)
    assert path.read_bytes() == sound
    assert os.listdir(path.parent) == [path.name]


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
        careless.setattr(bounds, 'check', lambda _: None)
        save(LARGE[words], path)
    with pytest.raises(ModelFileError, match=f'its content is inconsistent .{words}|more than a'):
        load(path)


def test_flipped_bits_are_refused(path, sound):
    rng = np.random.default_rng(12)
    # half of them in the header
    for end in [len(sound), 8 + int.from_bytes(sound[:8], 'little')] * 300:
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


def test_a_failing_replacement_leaves_no_temporary_and_a_missing_folder_is_not_made(path):
    path.mkdir()
    with pytest.raises(IsADirectoryError):
        save(MODELS['one layer'], path)
    with pytest.raises(FileNotFoundError):
        save(MODELS['one layer'], path / 'none' / 'model.safetensors')
    assert os.listdir(path.parent) == [path.name]
    assert os.listdir(path) == []


def test_a_reader_sees_the_old_file_or_the_new_one(path, sound, monkeypatch):
    replaced, seen = os.replace, []

    def replace_in_sight(source: str, target: Path) -> None:
        # the new one is whole before it takes the old one's place
        seen.extend((content(load(source)), content(load(target))))
        replaced(source, target)

    monkeypatch.setattr(os, 'replace', replace_in_sight)
    large = random_lift(widths=(2000,), seed=3)
    save(large, path)
    assert seen == [content(large), content(MODELS['one layer'])]
    assert content(load(path)) == content(large)


@pytest.mark.parametrize(('model', 'kind'), [
    (replace(random_lift(), provenance=replace(
        random_lift().provenance, model_class='neural drift')), 'neural drift'),
    (random_lift(), 'identity lift, n_z = '),
    (MODELS['free'], 'free lift, n_z = '),
    (MODELS['monomials'], 'polynomial'),
    (load(SHIPPED / 'reactor_nz4.safetensors'), 'identity lift, n_z = 4')])
def test_class_of_a_model_is_named(model: Any, kind: str, tmp_path: Path) -> None:
    save(model, tmp_path / 'model.safetensors')
    assert load(tmp_path / 'model.safetensors').kind.startswith(kind)


def test_class_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    wrong = replace(random_lift(), provenance=replace(
        random_lift().provenance, model_class='magic'))
    save(wrong, tmp_path / 'model.safetensors')
    with pytest.raises(ModelFileError, match='model_class must be one of linear'):
        load(tmp_path / 'model.safetensors')
