# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The model file: arrays and a JSON description in the safetensors format, no code."""

from dataclasses import asdict, dataclass, fields
import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
import safetensors.numpy

from koopman_ros.core.arrays import expect
from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.paths import write_atomically
from koopman_ros.core.signals import check_text
from koopman_ros.core.units import check_unit
from koopman_ros.model.coordinates import Coordinates, NO_SIGNALS
from koopman_ros.model.input_matrix import InputTerms
from koopman_ros.model.lifted_model import LiftedModel
from koopman_ros.model.observables import NetworkObservables, PolynomialObservables
from koopman_ros.model.provenance import Provenance
from koopman_ros.model.rate_band import RateBand
from koopman_ros.model.training_data import TrainingStates, VerifiedLoops
from koopman_ros.model_classes import CLASSES

FORMAT_VERSION = 1
# One entry, since the library writes several in an order that changes from process to process.
_KEY = 'koopman_ros.model'
_MAX_BYTES = 1 << 22

# Riccati equations of n_z coordinates cost n_z^3: 32 take some milliseconds on a processor of
# 2020, four times what training from bags allows; 50 take ten times as long, as BLAS divides
# them among threads, which wait for each other on a busy machine.
MAX_COORDINATES = 32
_MAX_STATES = 32  # and inputs; as many as coordinates
_MAX_DEGREE = 32  # of monomials; beyond some ten, little of them is left in numbers
_MAX_SENTENCE = 4000
_MAX_SEED = 1 << 128  # numpy's own seeds have up to 128 bits
_MAX_ENTRIES = 100  # metrics, or reasons
_COORDINATES = ('names', 'units', 'center', 'scale', 'lower', 'upper')
_MAX_REASON = 300  # characters of a rejection, which may quote the file

Tensors = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Magnitudes:
    """The largest sizes of a model's numbers; beyond them calculations overflow."""

    #: of weights, matrices and training states in scaled deviations and the model's time unit;
    #: trained models reach about 200, and one of a plant with time constants of microseconds 1e6
    scaled: float = 1e9
    #: of nominal points and ranges in the units of the signals; 1 over it for a scale
    physical: float = 1e15


class ModelFileError(ValueError):
    """A model file cannot be used; the message has the reason and the remedy."""


def save(model: LiftedModel, path: str | os.PathLike[str]) -> None:
    """
    Write a model; a reader sees the old file or the new one, never a part.

    >>> save(model, 'copy.safetensors')

    :raises OSError: when the folder cannot be written.
    :raises TypeError: for another class than a model, or another lift than of a network or of
        monomials.
    :raises ValueError: when :func:`load` would reject the file.
    """
    expect(model=(model, LiftedModel))
    check(model)
    about, tensors = _description(model), _tensors(model)
    metadata = json.dumps({'format_version': FORMAT_VERSION, 'model': about,
                           'sha256': _checksum(about, tensors)}, sort_keys=True, allow_nan=False)
    write_atomically(Path(path), safetensors.numpy.save(tensors, metadata={_KEY: metadata}))


def load(path: str | os.PathLike[str]) -> LiftedModel:
    """
    Read and check a model.

    >>> load('two_tanks.safetensors').inputs.names
    ('pump_1', 'pump_2')

    :raises ModelFileError: with the reason and the remedy.
    """
    return load_with_digest(path)[0]


def load_with_digest(path: str | os.PathLike[str]) -> tuple[LiftedModel, str]:
    """Read a model as :func:`load`, with the SHA-256 of its file."""
    path = Path(path)
    content = _read(path)
    try:
        model = _parsed(content)
        check(model)
    # whatever a hostile file makes the library, JSON or a constructor raise
    except Exception as error:
        reason = (f'it is not a safetensors file: {error}' if isinstance(error, SafetensorError)
                  else f'{error} is missing' if isinstance(error, KeyError) else str(error))
        if not reason.isprintable():
            reason = ascii(reason)
        if len(reason) > _MAX_REASON:
            reason = reason[:_MAX_REASON] + '...'
        raise ModelFileError(f'{path} is not a usable model file: {reason}; restore it from a '
                             'backup, or train the model again') from error
    return model, hashlib.sha256(content).hexdigest()


def digest(model: LiftedModel) -> str:
    """Return the SHA-256 of a model, which its file contains, in hexadecimal."""
    return _checksum(_description(model), _tensors(model))


def check(model: LiftedModel) -> None:
    """
    Check that a model can be controlled with, and that its texts fit logs and messages.

    :raises TypeError: for a name, unit or note of its origin that is not a text.
    :raises ValueError: naming the size and its limit, or the text and its error.
    """
    lift, origin = model.observables, model.provenance
    if not isinstance(lift, NetworkObservables | PolynomialObservables):
        raise TypeError('only lifts of networks and of monomials can be saved, got '
                        f'{type(lift).__name__}')
    degree = lift.degree if isinstance(lift, PolynomialObservables) else 0
    for name, size, limit in (
            ('n_z', model.n_z, MAX_COORDINATES), ('n_x', model.n_x, _MAX_STATES),
            ('n_u', model.n_u, _MAX_STATES),
            ('n_d', len(model.disturbances), _MAX_STATES),
            ('the degree', degree, _MAX_DEGREE),
            ('the degree of the input matrix', model.input_matrix_degree, _MAX_DEGREE),
            ('the number of metrics', len(origin.metrics), _MAX_ENTRIES),
            ('the number of reasons', len(origin.reasons), _MAX_ENTRIES)):
        if size > limit:
            raise ValueError(f'{name} is {size}, the maximum is {limit}')
    for signals in (model.states, model.inputs, model.disturbances):
        for name, unit in zip(signals.names, signals.units, strict=True):
            check_text('the name of a signal', name)
            check_text(f'the unit of {name}', unit)
            check_unit(unit)
    for name in ('plant', 'data_digest', 'package_version'):
        check_text(name, getattr(origin, name))
    for kind, text in (('method', origin.method), ('closed_loops', origin.closed_loops),
                       *(('a reason', reason) for reason in origin.reasons)):
        check_text(kind, text, _MAX_SENTENCE)
    for name, value in origin.metrics.items():
        check_text('the name of a metric', name)
        if not math.isfinite(value):
            raise ValueError(f'the metric {name} is {value}, not finite')
    if origin.seed is not None and not (
            type(origin.seed) is int and 0 <= origin.seed < _MAX_SEED):
        raise ValueError('the seed must be an integer of at least 0 and below 2^128')
    if origin.model_class not in ('', *CLASSES):
        raise ValueError(f'model_class must be one of {", ".join(CLASSES)}, got '
                         f'{origin.model_class!r}')
    _check_magnitudes(model)


def _check_magnitudes(model: LiftedModel, most: Magnitudes = Magnitudes()) -> None:
    """Raise a ValueError that names the signals of a number of impossible size, and the number."""
    for signals in (model.states, model.inputs, model.disturbances):
        curves = signals.characteristics
        for what, values in (
                *((name, getattr(signals, name)) for name in ('center', 'lower', 'upper',
                                                              'scale')),
                ('1 / scale', 1.0 / signals.scale),
                ('characteristic', [max(np.abs(curves[name].values).max(),
                                        np.abs(curves[name].effects).max())
                                    if name in curves else 0.0 for name in signals.names])):
            _check_size(what, np.asarray(values), (signals.names,), most.physical)
    states, inputs = model.states.names, model.inputs.names
    axes = {'W': (None, states), 'B': (states, inputs), 'E': (states, model.disturbances.names),
            'readout': (states, None), 'pre_feedback': (inputs, states),
            'input_terms': (None, states, inputs), 'training_states': (None, states),
            'verified_loops.starts': (None, states), 'verified_loops.setpoints': (None, states),
            'rate_band.error': (states,), **{f'rate_band.{name}': (None, states) for name in (
                'values', 'rates', 'lower', 'upper')}}
    for name, array in _tensors(model).items():
        _check_size(name, array, axes.get(name, (None,) * array.ndim), most.scaled)


def _check_size(what: str, values: NDArray[Any], names: tuple[tuple[str, ...] | None, ...],
                most: float) -> None:
    """
    Check the size of numbers.

    :param names: of the signals along each axis, None for an axis without signals.
    """
    if values.size and not np.abs(values).max() <= most:
        at = np.unravel_index(int(np.argmax(np.abs(values))), values.shape)
        place = ', '.join(str(i) if axis is None else axis[i]
                          for i, axis in zip(at, names, strict=True))
        raise ValueError(f'{what}[{place}] is {values[at]:.6g}, allowed are -{most:g} to {most:g}')


def _description(model: LiftedModel) -> dict[str, Any]:
    """Return all of a model that is not an array of weights, as JSON."""
    about: dict[str, Any] = {
        'inputs': _signals(model.inputs), 'provenance': asdict(model.provenance),
        'states': _signals(model.states), 'time_unit': model.time_unit}
    if not model.provenance.closed_loops:
        del about['provenance']['closed_loops']
    if isinstance(model.observables, NetworkObservables):
        about['identity'] = model.observables.identity
    if model.states_measured:
        about['states_measured'] = list(model.states_measured)
    if model.dead_time.any():
        about['dead_time'] = model.dead_time.tolist()
    if len(model.disturbances):
        about['disturbances'] = _signals(model.disturbances)
    if model.training_states is not None:
        about['fill_distance'] = model.training_states.fill_distance
    return about


def _signals(signals: Coordinates) -> dict[str, Any]:
    about: dict[str, Any] = {name: np.asarray(getattr(signals, name)).tolist()
                             for name in _COORDINATES}
    if signals.characteristics:
        about['characteristics'] = {name: [one.values.tolist(), one.effects.tolist()]
                                    for name, one in signals.characteristics.items()}
    return about


def _tensors(model: LiftedModel) -> Tensors:
    """Return the arrays of a model by name."""
    lift, tried, terms = model.observables, model.verified_loops, model.input_terms
    if isinstance(lift, NetworkObservables):
        found: dict[str, NDArray[Any] | None] = {'W': lift.W, 'b': lift.b, 'V': lift.V}
    else:
        assert isinstance(lift, PolynomialObservables)
        found = {'exponents': lift.exponents}
    found |= {
        'A': model.A, 'B': model.B, 'E': model.E if len(model.disturbances) else None,
        'readout': model.readout, 'pre_feedback': model.pre_feedback,
        'input_terms': None if terms is None else terms.coefficients,
        'training_states': None if model.training_states is None else (
            model.training_states.states)}
    for name, part in (('verified_loops', tried), ('rate_band', model.rate_band)):
        if part is not None:
            found |= {f'{name}.{one.name}': getattr(part, one.name) for one in fields(part)}
    return {name: np.ascontiguousarray(value) for name, value in found.items()
            if value is not None}


def _checksum(about: dict[str, Any], tensors: Tensors) -> str:
    """Return the SHA-256 of all that a model consists of, in hexadecimal."""
    sha = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in sorted(tensors):
        sha.update(f'{name}{tensors[name].dtype.str}{tensors[name].shape}'.encode())
        sha.update(tensors[name].tobytes())
    return sha.hexdigest()


def _read(path: Path) -> bytes:
    """Return the content of a regular file of a fair size."""
    try:
        # reading a pipe or a device may never end
        if path.exists() and not path.is_file():
            raise ModelFileError(f'cannot read the model file {path}: it is not a regular file')
        with open(path, 'rb') as file:
            content = file.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        raise ModelFileError(
            f'no model file at {path}: check the path, or train a model') from None
    except OSError as error:
        raise ModelFileError(f'cannot read the model file {path}: {error.strerror}') from error
    if len(content) > _MAX_BYTES:
        raise ModelFileError(f'{path} is not a usable model file: it has more than {_MAX_BYTES} '
                             'bytes, the maximum; check the path')
    return content


def _parsed(content: bytes) -> LiftedModel:
    """Return the model of a file; errors of its parts pass."""
    tensors: Tensors = safetensors.numpy.load(content)
    # the library has checked the header, and gives its metadata for paths alone
    header = json.loads(content[8:8 + int.from_bytes(content[:8], 'little')])
    if _KEY not in header.get('__metadata__', {}):
        raise ValueError('it is a safetensors file, but not of a model')
    metadata = json.loads(header['__metadata__'][_KEY])
    if (version := metadata['format_version']) != FORMAT_VERSION:
        raise ValueError(f'it has format version {version!r}, this package reads '
                         f'{FORMAT_VERSION}')
    about = metadata['model']
    if metadata['sha256'] != _checksum(about, tensors):
        raise ValueError('its checksum is wrong: the file was damaged or edited')
    for name, array in tensors.items():
        expected = {'exponents': np.int64, 'verified_loops.lost': np.bool_}.get(name, np.float64)
        if array.dtype != expected:
            raise ValueError(f'the array {name!r} has type {array.dtype}, expected {expected}')
    return _model(about, tensors)


def _model(about: dict[str, Any], tensors: Tensors) -> LiftedModel:
    """Build a model of its description and arrays."""
    lift = (PolynomialObservables(tensors.pop('exponents')) if 'exponents' in tensors else
            NetworkObservables(tensors.pop('W'), tensors.pop('b'), tensors.pop('V'),
                               identity=_of_type(bool, about, 'identity')))
    terms, known = tensors.pop('input_terms', None), tensors.pop('training_states', None)
    tried = None if 'verified_loops.starts' not in tensors else VerifiedLoops(
        *(tensors.pop(f'verified_loops.{one.name}') for one in fields(VerifiedLoops)))
    band = None if 'rate_band.error' not in tensors else RateBand(
        *(tensors.pop(f'rate_band.{one.name}') for one in fields(RateBand)))
    origin = dict(about['provenance'])
    origin['metrics'] = {name: float(value) for name, value in origin['metrics'].items()}
    origin['reasons'] = tuple(_of_type(list, origin, 'reasons'))
    if origin['accepted'] is not None:
        _of_type(bool, origin, 'accepted')
    model = LiftedModel(
        lift, tensors.pop('A'), tensors.pop('B'), _coordinates(about['states']),
        _coordinates(about['inputs']), about['time_unit'], Provenance(**origin),
        training_states=None if known is None else TrainingStates(
            known, _of_type(float, about, 'fill_distance')),
        readout=tensors.pop('readout', None),
        input_terms=None if terms is None else InputTerms(terms),
        pre_feedback=tensors.pop('pre_feedback', None),
        verified_loops=tried, rate_band=band,
        dead_time=np.array(_of_type(list, about, 'dead_time') if 'dead_time' in about else 0.0,
                           dtype=np.float64),
        disturbances=(_coordinates(about['disturbances']) if 'disturbances' in about
                      else NO_SIGNALS),
        E=tensors.pop('E', None),
        states_measured=tuple(_of_type(list, about, 'states_measured')
                              if 'states_measured' in about else ()))
    if tensors:
        raise ValueError(f'it holds unknown arrays: {", ".join(sorted(tensors))}')
    return model


def _coordinates(about: dict[str, Any]) -> Coordinates:
    names, units, *values = (_of_type(list, about, name) for name in _COORDINATES)
    return Coordinates(tuple(names), tuple(units), *(
        np.array(value, dtype=np.float64) for value in values), characteristics={
            name: Characteristic(*(np.array(one, dtype=np.float64) for one in points))
            for name, points in about.get('characteristics', {}).items()})


def _of_type(kind: type, about: dict[str, Any], name: str) -> Any:
    if not isinstance(about[name], kind):
        raise TypeError(f'{name} must be a {kind.__name__}, got {about[name]!r}')
    return about[name]
