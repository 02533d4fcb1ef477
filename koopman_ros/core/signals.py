# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Signals: one number for each by name, and the measured outputs of the state."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopman_ros.core.arrays import Array, frozen, real


def check_text(what: str, text: object, longest: int = 100) -> None:
    """
    Check a text that a model file holds; its names have at most 100 characters.

    :raises TypeError: unless it is a string.
    :raises ValueError: where it is longer, or has characters that cannot be printed.
    """
    if not isinstance(text, str):
        raise TypeError(f'{what} must be a string, got {text!r}')
    if len(text) > longest:
        raise ValueError(f'{what} has {len(text)} characters, the maximum is {longest}')
    if not text.isprintable():
        raise ValueError(f'{what} = {text!a} contains unprintable characters')


def numbers(name: str, value: Any, signals: Sequence[str], remedy: str = '') -> Array:
    """
    Return one number for each of some signals (n,) as an array.

    :raises ValueError: for another size, or a Series of pandas with the signals in another order.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = real(value, name)  # which says what is wrong
    if array.ndim == 0 and len(signals) == 1:
        array = array[None]
    if array.shape != (len(signals),):
        raise _wrong_size(name, array, signals, remedy)
    # the rows of a Series of pandas have names
    own = [str(one) for one in value.index] if hasattr(value, 'iloc') else list(signals)
    if own != list(signals) and sorted(own) == sorted(signals):
        raise ValueError(f'the {name} has the order {", ".join(own)}: pass it in the order '
                         f'{", ".join(signals)}')
    return array


def per_signal(name: str, value: Array, signals: Sequence[str]) -> None:
    """
    Check that an array (n,) holds one number for each of (n,) signals; nothing broadcasts.

    :raises ValueError: when the sizes differ, or a number is NaN.
    """
    if not isinstance(value, np.ndarray) or value.shape != (len(signals),):
        raise _wrong_size(name, value, signals)
    if np.isnan(value).any():
        raise ValueError(f'{name} must be numbers, got {value.tolist()}')


def _wrong_size(name: str, value: ArrayLike, signals: Sequence[str], remedy: str = ''
                ) -> ValueError:
    array = np.asarray(value)
    return ValueError(
        f'incompatible {name}: expected one number for each of {", ".join(signals)}, got '
        f'{array.tolist()}, ' + (
            f'{array.size} in place of {len(signals)}' if array.size != len(signals) else
            f'an array of the shape {array.shape} in place of {(len(signals),)}')
        + f'; {remedy}' * bool(remedy))


@dataclass(frozen=True)
class Outputs:
    """The measured outputs: y = C x, in the units of the signals."""

    names: tuple[str, ...]  #: (n_y,) of the measured signals
    units: tuple[str, ...]  #: (n_y,) their units
    C: Array  #: (n_y, n_x) in those units per state unit

    def __post_init__(self) -> None:
        C = np.array(self.C, dtype=np.float64)
        if len(self.units) != len(self.names) or C.ndim != 2 or len(C) != len(self.names):
            raise ValueError(f'incompatible outputs: {len(self.names)} names, {len(self.units)} '
                             f'units, C of shape {C.shape}')
        object.__setattr__(self, 'C', frozen(C, 'C', C.shape))

    @cached_property
    def all_states(self) -> bool:
        """Whether every state is measured by itself."""
        return self.C.shape[0] == self.C.shape[1] and bool((np.eye(len(self.C)) == self.C).all())

    @cached_property
    def determine_state(self) -> bool:
        """Whether they leave nothing of the state open."""
        return self.determine(())

    def determine(self, known: Collection[int]) -> bool:
        """Whether they determine all states but some that follow from the inputs alone."""
        rest = [i for i, column in enumerate(self.C.T) if i not in known or column.any()]
        return len(rest) == len(self.C) == np.linalg.matrix_rank(self.C)

    @cached_property
    def _inverse(self) -> Array:
        inverse = np.linalg.inv if self.determine_state else np.linalg.pinv
        return np.asarray(inverse(self.C), dtype=np.float64)

    def of(self, x: Array) -> Array:
        """Return the outputs (n_y,) of a state (n_x,) or of a difference of states."""
        return x if self.all_states else self.C.dot(x)

    def state(self, y: Array, guess: Array) -> Array:
        """
        Return the state, (n_x,), of outputs (n_y,).

        :param guess: (n_x,) state for the components that they do not determine.
        """
        if self.all_states:
            return y
        if self.determine_state:
            return self._inverse.dot(y)
        found: Array = guess + self._inverse.dot(y - self.C.dot(guess))
        return found
