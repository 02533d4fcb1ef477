# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What may happen to a message on its way."""

from __future__ import annotations

import numpy as np
import pytest

from validation.faults.alterations import (
    delayed,
    frozen,
    lost,
    noise,
    Packet,
    stamped,
    stamps_frozen,
    swapped,
    twice,
    unchanged,
    value,
)

SENT = [Packet(k * 1_000_000_000, float(k)) for k in range(5, 11)]


def arriving(alter, sent=SENT):
    return [packet for message in sent for packet in alter(message)]


@pytest.mark.parametrize(('alter', 'expected'), [
    (unchanged, [5, 6, 7, 8, 9, 10]),
    (frozen(), [5, 5, 5, 5, 5, 5]),
    (value(lambda seconds, shown: shown + 10.0 * seconds), [5, 16, 27, 38, 49, 60]),
    (lost(), []),
    (lost(0.0), [5, 6, 7, 8, 9, 10]),
    (twice, [5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10]),
    (swapped(), [6, 5, 8, 7, 10, 9]),
    (delayed(2), [5, 6, 7, 8])])
def test_values_that_arrive(alter, expected):
    assert [packet.celsius for packet in arriving(alter)] == expected


@pytest.mark.parametrize('alter', [frozen(), value(lambda *_: 1.0), noise(1.0)])
def test_values_change_and_stamps_do_not(alter):
    assert [packet.stamp_ns for packet in arriving(alter)] == [p.stamp_ns for p in SENT]


@pytest.mark.parametrize(('alter', 'expected'), [
    (stamped(lambda stamp_ns: stamp_ns - 7), [p.stamp_ns - 7 for p in SENT]),
    (stamps_frozen(), [SENT[0].stamp_ns] * 6)])
def test_stamps_change_and_values_do_not(alter, expected):
    assert [packet.stamp_ns for packet in arriving(alter)] == expected
    assert [packet.celsius for packet in arriving(alter)] == [p.celsius for p in SENT]


def test_a_share_is_lost_the_same_every_time():
    many = [Packet(k, float(k)) for k in range(1000)]
    assert 650 < len(arriving(lost(0.3), many)) < 750
    assert arriving(lost(0.3), many) == arriving(lost(0.3), many)


def test_noise_has_the_deviation_asked_for():
    shown = np.array([packet.celsius for packet in arriving(
        noise(2.0), [Packet(k, 40.0) for k in range(4000)])])
    assert np.mean(shown) == pytest.approx(40.0, abs=0.15)
    assert np.std(shown) == pytest.approx(2.0, rel=0.05)
