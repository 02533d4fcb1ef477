# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Where numbers lie in the bytes of messages, found by asking their decoder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Some numbers in a decoded message, None for one that it lacks.
Numbers = Callable[[Any], Sequence[float | int | None]]

_LONGEST = 1024  # bytes: a longer message is decoded by itself
_ENCAPSULATION = 4  # bytes, which say how the others are to be read
# What is done to a byte to see what it is for: a length that becomes 254 larger leads out of the
# message, one that changes by 1 or 16 shows where the first does not.
_FLIPS = (0x01, 0x10, 0xFF)
_KINDS = tuple(np.dtype(order + kind) for kind in ('f8', 'f4', 'i8', 'u8', 'i4', 'u4', 'i2', 'u2',
                                                   'i1', 'u1') for order in '<>')


@dataclass(frozen=True)
class Layout:
    """Where some numbers are in messages that have a shape in common, p of them."""

    length: int  #: bytes of such a message
    fixed: NDArray[np.int64]  #: where the bytes are that make the shape: lengths, names, texts
    shape: NDArray[np.uint8]  #: what they are
    #: (p,) where each number begins, and its type; None for one that is not there
    numbers: tuple[tuple[int, np.dtype[Any]] | None, ...]

    def fits(self, data: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Tell which of some messages (n, length) have the shape."""
        found: NDArray[np.bool_] = np.all(data[:, self.fixed] == self.shape, axis=1)
        return found

    def column(self, data: NDArray[np.uint8], k: int) -> NDArray[Any] | None:
        """Return the k-th number (n,) of messages (n, length) that fit, as it was sent."""
        if (place := self.numbers[k]) is None:
            return None
        start, kind = place
        found: NDArray[Any] = np.ascontiguousarray(
            data[:, start:start + kind.itemsize]).view(kind)[:, 0]
        return found


def layout_of(data: bytes, decode: Callable[[bytes], Any], numbers: Numbers) -> Layout | None:
    """
    Find where numbers are in the messages that are like a given one, or None.

    Each byte is changed to see what it does. One that changes lengths, texts, or whether there is
    a message at all, belongs to the shape; the others may have any value. The decoder of such
    messages thus finds the same numbers in the same bytes.

    :param data: a message that decodes.
    :param numbers: gives what is looked for in a decoded message.
    """
    if len(data) > _LONGEST:
        return None
    message = decode(data)
    shape, wanted = _shape(message), numbers(message)
    fixed = list(range(_ENCAPSULATION))
    spans: list[list[int]] = [[] for _ in wanted]
    for at in range(_ENCAPSULATION, len(data)):
        for flip in _FLIPS:
            try:
                other = decode(_changed(data, at, bytes([data[at] ^ flip])))
            # as many ways as bytes can be wrong
            except Exception:
                other = None
            if other is None or _shape(other) != shape:
                fixed.append(at)
                break
            for span, before, after in zip(spans, wanted, numbers(other), strict=True):
                if not _same(before, after) and at not in span:
                    span.append(at)
    places = []
    for k, (span, value) in enumerate(zip(spans, wanted, strict=True)):
        kind = None if value is None else _kind(data, span, decode, partial(_number, numbers, k))
        if value is not None and (kind is None or set(span) & set(fixed)):
            return None
        places.append(None if kind is None else (span[0], kind))
    return Layout(len(data), np.array(fixed), np.frombuffer(data, dtype=np.uint8)[fixed],
                  tuple(places))


def _kind(data: bytes, span: list[int], decode: Callable[[bytes], Any],
          number: Callable[[Any], float | int | None]) -> np.dtype[Any] | None:
    """Return the type of the number in some bytes, None where it is of no type known here."""
    size = len(span)
    if not span or span != list(range(span[0], span[0] + size)):
        return None
    # no two types agree on all of them
    probes = [data[span[0]:span[0] + size], bytes(range(1, size + 1)), b'\xff' + b'\xfe' * (
        size - 1), b'\xbf' * size]
    for kind in _KINDS:
        if kind.itemsize == size and all(
                _same(number(decode(_changed(data, span[0], probe))),
                      np.frombuffer(probe, dtype=kind)[0].item()) for probe in probes):
            return kind
    return None


def _number(numbers: Numbers, k: int, message: Any) -> float | int | None:
    return numbers(message)[k]


def _changed(data: bytes, at: int, by: bytes) -> bytes:
    return data[:at] + by + data[at + len(by):]


def _same(a: float | int | None, b: float | int | None) -> bool:
    """Tell whether two numbers are the same bit by bit, NaN and signed zeros too."""
    if a is None or b is None:
        return a is b
    return struct.pack('<d', a) == struct.pack('<d', b)


def _shape(value: Any) -> Any:
    """Return what of a decoded message is no number."""
    if isinstance(value, (bool, int, float)):
        return type(value)
    if isinstance(value, str):
        return value
    if isinstance(value, (bytes, bytearray)):
        return bytes, len(value)
    if isinstance(value, (list, tuple)):
        return [_shape(one) for one in value]
    return {name: _shape(getattr(value, name)) for name in value.__slots__}
