# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The model file: one .safetensors file, written atomically and read with numpy alone."""

from collections.abc import Iterable
import contextlib
import hashlib
import json
import math
import os
from pathlib import Path
import tempfile
from typing import Any, NoReturn

import numpy as np

from koopman_ros.lifting import bounds
from koopman_ros.lifting.activations import activation_named
from koopman_ros.lifting.coordinates import Coordinates, TrainingStates, TriedLoops
from koopman_ros.lifting.input_terms import InputTerms
from koopman_ros.lifting.model import LiftedModel, Provenance
from koopman_ros.lifting.observables import NetworkObservables, PolynomialObservables
from koopman_ros.model_classes import CLASSES
from koopman_ros.units import check_unit

FORMAT = 'koopman_ros.lift'
FORMAT_VERSION = 1

# A lift is small, see the bounds; a header or file beyond these sizes is not one.
_MAX_HEADER_BYTES = 1 << 20
_MAX_FILE_BYTES = 1 << 22
_MAX_REASON = 300  # characters of what is wrong with a file, which may quote it
_COORDINATE_ARRAYS = ('center', 'scale', 'lower', 'upper')


class ModelFileError(ValueError):
    """A model file cannot be used; the message says why and what to do."""


def save(model: LiftedModel, path: str | os.PathLike[str]) -> None:
    """
    Write a model as safetensors; a reader sees the old file or the new one, never a part.

    :raises OSError: when the folder cannot be written.
    :raises TypeError: when the lift is neither a network's nor of monomials.
    :raises ValueError: when :func:`load` would refuse it, e.g. for a metric that is not finite.
    """
    lift, network = model.observables, {}
    tensors = {'A': model.A, 'B': model.B}
    if isinstance(lift, PolynomialObservables):
        tensors['exponents'] = lift.exponents.astype(np.float64)
    elif isinstance(lift, NetworkObservables):
        network = {'activation': lift.activation, 'hidden_layers': len(lift.hidden),
                   'identity': lift.identity}
        tensors['output'] = lift.output
        for i, (weight, bias) in enumerate(lift.hidden):
            tensors[f'hidden.{i}.weight'] = weight
            tensors[f'hidden.{i}.bias'] = bias
    else:
        raise TypeError('only lifts of networks and of monomials can be saved, got '
                        f'{type(lift).__name__}: keep the program that makes the model instead')
    _check(model)
    known = model.training_states
    if known is not None:
        tensors['training_states'] = known.states
    if model.readout is not None:
        tensors['readout'] = model.readout
    if model.input_terms is not None:
        C = model.input_terms.coefficients
        tensors['input_terms'] = C.reshape(len(C), -1)
    if model.pre_feedback is not None:
        tensors['pre_feedback'] = model.pre_feedback
    tried = model.tried_loops
    if tried is not None:
        tensors['tried_loops'] = np.column_stack([tried.starts, tried.setpoints, tried.lost])
    description = json.dumps({
        **network,
        **({'fill_distance': known.fill_distance} if known is not None else {}),
        'inputs': _describe(model.inputs),
        'n_u': model.n_u,
        'n_x': model.n_x,
        'n_z': model.n_z,
        'provenance': {
            'data_digest': model.provenance.data_digest,
            'metrics': dict(model.provenance.metrics),
            **({'method': model.provenance.method} if model.provenance.method else {}),
            **({'model_class': model.provenance.model_class} if model.provenance.model_class
               else {}),
            **({'refused': list(model.provenance.refused)} if model.provenance.refused else {}),
            'package_version': model.provenance.package_version,
            'plant': model.provenance.plant,
            'seed': model.provenance.seed,
        },
        'states': _describe(model.states),
        'time_unit': model.time_unit,
    }, sort_keys=True, allow_nan=False)
    arrays: dict[str, Any] = {}
    offset, chunks = 0, []
    for name in sorted(tensors):
        data = np.ascontiguousarray(tensors[name]).astype('<f8').tobytes()
        arrays[name] = {'dtype': 'F64', 'shape': list(tensors[name].shape),
                        'data_offsets': [offset, offset + len(data)]}
        offset += len(data)
        chunks.append(data)
    header = {'__metadata__': {
        'format': FORMAT, 'format_version': str(FORMAT_VERSION), 'description': description,
        'sha256': _checksum(description, arrays, b''.join(chunks))}, **arrays}
    text = json.dumps(header, separators=(',', ':')).encode()
    text += b' ' * (-len(text) % 8)
    _write_atomically(Path(path), [len(text).to_bytes(8, 'little'), text, *chunks])


def load(path: str | os.PathLike[str]) -> LiftedModel:
    """Read a model and check every field; raise ModelFileError with what is wrong and to do."""
    return load_with_digest(path)[0]


def load_with_digest(path: str | os.PathLike[str]) -> tuple[LiftedModel, str]:
    """Read a model as :func:`load` does, with the SHA-256 digest of the file it was read from."""
    path = Path(path)
    try:
        content = bounds.read_regular(path, _MAX_FILE_BYTES)
    except FileNotFoundError:
        raise ModelFileError(
            f'no model file at {path}: check the path, or train a model') from None
    except bounds.NotRegularError as error:
        raise ModelFileError(f'cannot read the model file {path}: {error}') from None
    except OSError as error:
        raise ModelFileError(f'cannot read the model file {path}: {error.strerror}') from error
    if len(content) > _MAX_FILE_BYTES:
        _refuse(path, f'it is more than {_MAX_FILE_BYTES} bytes long, far more than any lift')
    header, data = _split_file(path, content)
    metadata = header.pop('__metadata__', None)
    if not isinstance(metadata, dict) or metadata.get('format') != FORMAT:
        _refuse(path, 'it is a safetensors file of something else')
    version = metadata.get('format_version')
    if version != str(FORMAT_VERSION):
        raise ModelFileError(
            f'the model file {path} has format version {version!r}, this package reads '
            f'{FORMAT_VERSION}: retrain the model, or install the matching package')
    if len(header) > 2 * bounds.MAX_LAYERS + 7:
        _refuse(path, f'it holds {len(header)} arrays, more than any lift')
    tensors = {name: _tensor(path, name, entry, data) for name, entry in header.items()}
    try:
        about = _parsed(metadata['description'])
        model = _build(about, tensors)
        _check(model)
        # last, so that whatever has a reason of its own is refused with that reason
        if metadata['sha256'] != _checksum(metadata['description'], header, data):
            raise ValueError('its checksum is wrong, so it was damaged or edited')
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError,
            RecursionError) as error:
        reason = f'{error.args[0]!r} is missing' if isinstance(error, KeyError) else str(error)
        _refuse(path, f'its content is inconsistent ({reason})')
    return model, hashlib.sha256(content).hexdigest()


def _check(model: LiftedModel) -> None:
    """Raise ValueError for a model beyond the bounds, or with a unit that does not exist."""
    bounds.check(model)
    for signals in (model.states, model.inputs):
        for name, unit in zip(signals.names, signals.units, strict=True):
            if not isinstance(unit, str):
                raise TypeError(f'the unit of {name!r} must be a text, got {unit!r}')
            try:
                check_unit(unit)
            except ValueError as error:
                raise ValueError(f'the unit of {name!r}: {error}') from error


def _build(about: dict[str, Any], tensors: dict[str, np.ndarray]) -> LiftedModel:
    """Assemble the model; whatever does not fit raises one of the errors `load` translates."""
    monomials = 'exponents' in tensors
    layers = 0
    if not monomials:
        activation_named(about['activation'])
        layers = _integer(about, 'hidden_layers')
    if layers > len(tensors):
        raise ValueError(f'{len(tensors)} arrays cannot make up {layers} hidden layers')
    expected = {'A', 'B', 'exponents' if monomials else 'output'} | {
        f'hidden.{i}.{part}' for i in range(layers) for part in ('weight', 'bias')}
    if 'fill_distance' in about:
        expected.add('training_states')
    # files without them are of lifts whose drift is read off the rate of z, whose B is constant,
    # whose A is of the plant alone, and whose law is lost nowhere
    expected |= {'readout', 'input_terms', 'pre_feedback', 'tried_loops'} & set(tensors)
    if set(tensors) != expected:
        raise ValueError(f'expected the arrays {sorted(expected)}, got {sorted(tensors)}')
    if not monomials and not isinstance(about['identity'], bool):
        raise TypeError('identity must be true or false')
    origin = about['provenance']
    metrics = {name: float(value) for name, value in origin['metrics'].items()}
    filled: Any = about.get('fill_distance')
    if 'fill_distance' in about and (
            not isinstance(filled, int | float) or isinstance(filled, bool)):
        raise TypeError(f'fill_distance must be a number, got {filled!r}')
    model = LiftedModel(
        observables=_monomials(tensors['exponents']) if monomials else NetworkObservables(
            hidden=tuple((tensors[f'hidden.{i}.weight'], tensors[f'hidden.{i}.bias'])
                         for i in range(layers)),
            output=tensors['output'], identity=about['identity'],
            activation=about['activation']),
        A=tensors['A'], B=tensors['B'],
        states=_coordinates(about['states']), inputs=_coordinates(about['inputs']),
        time_unit=about['time_unit'],
        provenance=Provenance(
            plant=origin['plant'],
            seed=None if origin['seed'] is None else _integer(origin, 'seed'),
            data_digest=origin['data_digest'], metrics=metrics,
            package_version=origin['package_version'],
            method=origin.get('method', ''), model_class=_class(origin),
            refused=_texts(origin, 'refused')),
        training_states=None if 'fill_distance' not in about else TrainingStates(
            tensors['training_states'], float(filled)),
        readout=tensors.get('readout'),
        input_terms=None if 'input_terms' not in tensors else InputTerms(
            tensors['input_terms'].reshape(len(tensors['input_terms']), *tensors['B'].shape)),
        pre_feedback=tensors.get('pre_feedback'),
        tried_loops=None if 'tried_loops' not in tensors else _tried(tensors['tried_loops']))
    for name, actual in (('n_x', model.n_x), ('n_u', model.n_u), ('n_z', model.n_z)):
        if _integer(about, name) != actual:
            raise ValueError(f'{name} is given as {about[name]}, the arrays say {actual}')
    return model


def _monomials(exponents: np.ndarray) -> PolynomialObservables:
    rounded = np.rint(np.clip(exponents, -1.0, bounds.MAX_DEGREE + 1.0))
    if not np.array_equal(rounded, exponents):
        raise ValueError(f'exponents must be whole numbers from 0 to {bounds.MAX_DEGREE}')
    return PolynomialObservables(rounded.astype(np.int64))


def _tried(rows: np.ndarray) -> TriedLoops:
    if rows.ndim != 2 or rows.shape[1] % 2 == 0:
        raise ValueError(f'incompatible tried_loops: expected (N, 2 n_x + 1), got {rows.shape}')
    n_x, lost = rows.shape[1] // 2, rows[:, -1]
    if not np.isin(lost, (0.0, 1.0)).all():
        raise ValueError('the last column of tried_loops must be 0 or 1')
    return TriedLoops(rows[:, :n_x], rows[:, n_x:-1], lost == 1.0)


def _checksum(description: str, arrays: dict[str, Any], data: bytes) -> str:
    """Return the SHA-256 over all that a model consists of, in hexadecimal."""
    index = json.dumps(arrays, sort_keys=True)
    return hashlib.sha256(b'\0'.join((description.encode(), index.encode(), data))).hexdigest()


def _class(origin: dict[str, Any]) -> str:
    name = origin.get('model_class', '')
    if name not in ('', *CLASSES):
        raise ValueError(f'model_class must be one of {", ".join(CLASSES)}, got {name!r}')
    return str(name)


def _texts(about: dict[str, Any], name: str) -> tuple[str, ...]:
    value = about.get(name, [])
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise TypeError(f'{name} must be a list of texts, got {value!r}')
    return tuple(value)


def _integer(about: dict[str, Any], name: str) -> int:
    value = about[name]
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise TypeError(f'{name} must be an integer of at least 0, got {value!r}')
    return value


def _describe(coordinates: Coordinates) -> dict[str, Any]:
    return {'names': list(coordinates.names), 'units': list(coordinates.units),
            **{name: getattr(coordinates, name).tolist() for name in _COORDINATE_ARRAYS}}


def _coordinates(about: dict[str, Any]) -> Coordinates:
    return Coordinates(names=tuple(about['names']), units=tuple(about['units']),
                       **{name: np.array(about[name], dtype=np.float64)
                          for name in _COORDINATE_ARRAYS})


def _split_file(path: Path, content: bytes) -> tuple[dict[str, Any], bytes]:
    """Separate the JSON header from the data, checking that nothing is cut off."""
    if len(content) < 8:
        _refuse(path, f'it is only {len(content)} bytes long, so it was cut off or is empty')
    length = int.from_bytes(content[:8], 'little')
    if length <= _MAX_HEADER_BYTES and len(content) < 8 + length:
        _refuse(path, 'it ends within its header, so it was cut off')
    data = content[8 + length:]
    try:
        header = _parsed(content[8:8 + length] if length <= _MAX_HEADER_BYTES else b'')
        end = max((int(entry['data_offsets'][1]) for name, entry in header.items()
                   if name != '__metadata__'), default=0)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError,
            RecursionError):
        _refuse(path, 'it is not a safetensors file')
    if len(data) < end:
        _refuse(path, f'{end - len(data)} bytes of its arrays are missing, so it was cut off')
    if len(data) > end:
        _refuse(path, f'it has {len(data) - end} bytes too many')
    return header, data


def _tensor(path: Path, name: str, entry: Any, data: bytes) -> np.ndarray:
    """Decode one array, checking type, size and values."""
    try:
        shape = tuple(_size(n) for n in entry['shape'])
        start, end = (_size(n) for n in entry['data_offsets'])
        dtype = entry['dtype']
    except (KeyError, TypeError, ValueError):
        _refuse(path, f'the entry of the array {name!r} is malformed')
    if dtype != 'F64':
        _refuse(path, f'the array {name!r} has type {dtype!r}, expected F64')
    if len(shape) > 2:
        _refuse(path, f'the array {name!r} has {len(shape)} dimensions, expected at most 2')
    if end - start != 8 * math.prod(shape):
        _refuse(path, f'the array {name!r} of shape {shape} does not fit its {end - start} bytes')
    array = np.frombuffer(data[start:end], dtype='<f8').reshape(shape)
    if not np.all(np.isfinite(array)):
        _refuse(path, f'the array {name!r} holds values that are not finite')
    return array


def _size(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or (
            not 0 <= value <= _MAX_FILE_BYTES):
        raise ValueError(f'{value!r} is no size of an array')
    return value


def _parsed(text: str | bytes) -> Any:
    """Read JSON in which no name comes twice, as readers differ in which of the two counts."""
    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError('a name comes twice')
        return found

    return json.loads(text, object_pairs_hook=once)


def _refuse(path: Path, reason: str) -> NoReturn:
    if len(reason) > _MAX_REASON:
        reason = reason[:_MAX_REASON] + '...'
    raise ModelFileError(f'{path} is not a usable model file: {reason}; '
                         'restore it from a backup, or train the model again')


def _write_atomically(path: Path, chunks: Iterable[bytes]) -> None:
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix='.tmp')
    try:
        with os.fdopen(descriptor, 'wb') as file:
            file.writelines(chunks)
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise
