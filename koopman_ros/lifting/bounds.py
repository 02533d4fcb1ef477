# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Limits of a model file: a regular one, sizes that a step has time for, printable texts."""

import math
import os
import stat

import numpy as np

from koopman_ros.lifting.model import LiftedModel
from koopman_ros.lifting.observables import NetworkObservables, PolynomialObservables

# Riccati equations of n_z coordinates cost n_z^3: 32 take some milliseconds on a processor of
# 2020, four times what training from bags allows; 50 take ten times as long, as BLAS divides
# them among threads, which wait for each other on a busy machine.
MAX_COORDINATES = 32
MAX_STATES = 32  # and inputs; as many as coordinates
MAX_LAYERS = 8  # training makes 1 or 2
# All weights of the lift: training makes some hundred, 2^18 take a millisecond a step.
MAX_WEIGHTS = 1 << 18
MAX_DEGREE = 32  # of monomials; beyond some ten, little of them is left in numbers
MAX_TEXT = 100  # characters; a SHA-256 in hexadecimal has 64
MAX_LONG_TEXT = 200  # for what is written in words
MAX_METRICS = 100
MAX_SEED = 1 << 128  # numpy's own seeds have up to 128 bits

_KINDS = ((stat.S_ISDIR, 'a folder'), (stat.S_ISFIFO, 'a named pipe'), (stat.S_ISSOCK, 'a socket'),
          (stat.S_ISCHR, 'a device'), (stat.S_ISBLK, 'a device'))


def check(model: LiftedModel) -> None:
    """
    Refuse a model too large to control with, or with texts that no log or message could carry.

    :raises TypeError: when a name, a unit or a note on its origin is no text.
    :raises ValueError: naming the size and its limit, or the text and what is wrong with it.
    """
    sizes = [('n_z', model.n_z, MAX_COORDINATES), ('n_x', model.n_x, MAX_STATES),
             ('n_u', model.n_u, MAX_STATES)]
    network = model.observables
    if isinstance(network, NetworkObservables):
        weights = network.output.size + sum(w.size + b.size for w, b in network.hidden)
        sizes += [('the number of hidden layers', len(network.hidden), MAX_LAYERS),
                  ('the number of weights', weights, MAX_WEIGHTS)]
    elif isinstance(network, PolynomialObservables):
        sizes += [('the degree', int(np.max(np.sum(network.exponents, axis=1))), MAX_DEGREE)]
    if model.input_terms is not None:
        sizes += [('the degree of the input matrix', model.input_terms.degree, MAX_DEGREE),
                  ('the size of the input matrix', model.input_terms.coefficients.size,
                   MAX_WEIGHTS)]
    for name, size, limit in sizes:
        if size > limit:
            raise ValueError(f'{name} is {size}, at most {limit} can be controlled with')
    origin = model.provenance
    for what, box in (('state', model.states), ('input', model.inputs)):
        for name, unit in zip(box.names, box.units, strict=True):
            _check_text(f'the name of a {what}', name)
            _check_text(f'the unit of a {what}', unit)
    _check_text('plant', origin.plant, MAX_LONG_TEXT)
    _check_text('method', origin.method, MAX_LONG_TEXT)
    _check_text('data_digest', origin.data_digest)
    _check_text('package_version', origin.package_version)
    if len(origin.metrics) > MAX_METRICS:
        raise ValueError(f'there are {len(origin.metrics)} metrics, at most {MAX_METRICS} may be')
    for name, value in origin.metrics.items():
        _check_text('the name of a metric', name)
        if not math.isfinite(value):
            raise ValueError(f'the metric {name} is {value}, not finite')
    if origin.seed is not None and not 0 <= origin.seed < MAX_SEED:
        raise ValueError('the seed must be an integer of at least 0 and below 2^128')


def _check_text(what: str, text: str, longest: int = MAX_TEXT) -> None:
    if not isinstance(text, str):
        raise TypeError(f'{what} must be a text, got {text!r}')
    if len(text) > longest:
        raise ValueError(f'{what} has {len(text)} characters, at most {longest} may be')
    if not text.isprintable():
        # what ascii() leaves can be encoded, whatever the text was
        raise ValueError(f'{what} = {text!a} holds characters that cannot be shown')


class NotRegularError(OSError):
    """The path is no regular file; the message says what it is."""


def read_regular(path: str | os.PathLike[str], limit: int) -> bytes:
    """
    Return what a regular file holds, or its first `limit` + 1 bytes.

    :raises NotRegularError: for a device, a pipe, a socket or a folder.
    :raises OSError: when it cannot be opened or read.
    """
    # looked at before it is opened, for opening is an order to some devices
    _refuse_special(os.stat(path))
    # a pipe that took its place would keep the opener waiting, and a terminal take it over
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    with open(descriptor, 'rb', buffering=0) as file:
        _refuse_special(os.fstat(descriptor))
        content = bytearray()
        while len(content) <= limit and (part := file.read(limit + 1 - len(content))):
            content += part
    return bytes(content)


def _refuse_special(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = next((word for test, word in _KINDS if test(found.st_mode)), 'something else')
        raise NotRegularError(f'it is {kind}, not a regular file')
