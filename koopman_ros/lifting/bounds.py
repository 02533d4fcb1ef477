# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Limits of a model file: sizes that a control step has time for, and printable texts."""

from collections.abc import Iterable
import math

from koopman_ros.lifting.model import LiftedModel
from koopman_ros.lifting.observables import NetworkObservables

# Riccati equations of n_z coordinates cost n_z^3: 32 take some milliseconds on a processor of
# 2020, four times what training from bags allows; 50 take ten times as long, as BLAS divides
# them among threads, which wait for each other on a busy machine.
MAX_COORDINATES = 32
MAX_STATES = 32  # and inputs; as many as coordinates
MAX_LAYERS = 8  # training makes 1 or 2
# All weights of the lift: training makes some hundred, 2^18 take a millisecond a step.
MAX_WEIGHTS = 1 << 18
MAX_TEXT = 100  # characters; a SHA-256 in hexadecimal has 64
MAX_LONG_TEXT = 200  # for what is written in words
MAX_METRICS = 100
MAX_SEED = 1 << 128  # numpy's own seeds have up to 128 bits


def check_sizes(model: LiftedModel) -> None:
    """
    Refuse a model that is too large to control with.

    :raises ValueError: naming the size and its limit.
    """
    sizes = [('n_z', model.n_z, MAX_COORDINATES), ('n_x', model.n_x, MAX_STATES),
             ('n_u', model.n_u, MAX_STATES)]
    network = model.observables
    if isinstance(network, NetworkObservables):
        weights = network.output.size + sum(w.size + b.size for w, b in network.hidden)
        sizes += [('the number of hidden layers', len(network.hidden), MAX_LAYERS),
                  ('the number of weights', weights, MAX_WEIGHTS)]
    for name, size, limit in sizes:
        if size > limit:
            raise ValueError(f'{name} is {size}, at most {limit} can be controlled with')


def check_texts(model: LiftedModel) -> None:
    """
    Refuse names, units and notes on its origin that no log and no message could carry.

    :raises ValueError: naming the text and what is wrong with it.
    """
    origin = model.provenance
    for what, box in (('state', model.states), ('input', model.inputs)):
        _check_all(f'the name of a {what}', box.names)
        _check_all(f'the unit of a {what}', box.units)
    _check('plant', origin.plant, MAX_LONG_TEXT)
    _check('method', origin.method, MAX_LONG_TEXT)
    _check('data_digest', origin.data_digest)
    _check('package_version', origin.package_version)
    if len(origin.metrics) > MAX_METRICS:
        raise ValueError(f'there are {len(origin.metrics)} metrics, at most {MAX_METRICS} may be')
    _check_all('the name of a metric', origin.metrics)
    for name, value in origin.metrics.items():
        if not math.isfinite(value):
            raise ValueError(f'the metric {name} is {value}, not finite')
    if origin.seed is not None and not 0 <= origin.seed < MAX_SEED:
        raise ValueError('the seed must be an integer of at least 0 and below 2^128')


def _check_all(what: str, texts: Iterable[str]) -> None:
    for text in texts:
        _check(what, text)


def _check(what: str, text: str, longest: int = MAX_TEXT) -> None:
    if not isinstance(text, str):
        raise TypeError(f'{what} must be a text, got {text!r}')
    if len(text) > longest:
        raise ValueError(f'{what} has {len(text)} characters, at most {longest} may be')
    if not text.isprintable():
        # what ascii() leaves can be encoded, whatever the text was
        raise ValueError(f'{what} = {text!a} holds characters that cannot be shown')
