# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What may happen to a message on its way."""

import numpy as np
import pytest

from validation.faults import alterations
from validation.faults.alterations import Packet

VALUES = [5, 6, 7, 8, 9, 10]
STAMPS = [k * 1_000_000_000 for k in VALUES]
SENT = [Packet(stamp, float(k)) for stamp, k in zip(STAMPS, VALUES, strict=True)]


def arriving(alter, sent=SENT):
    return [packet for message in sent for packet in alter(message)]


@pytest.mark.parametrize(('alter', 'values', 'stamps'), [
    (alterations.unchanged, VALUES, STAMPS),
    (alterations.frozen(), [5] * 6, STAMPS),
    (alterations.value(lambda seconds, shown: shown + 10.0 * seconds),
     [5, 16, 27, 38, 49, 60], STAMPS),
    (alterations.lost(), [], []),
    (alterations.lost(0.0), VALUES, STAMPS),
    (alterations.twice, [5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10], None),
    (alterations.swapped(), [6, 5, 8, 7, 10, 9], None),
    (alterations.delayed(2), [5, 6, 7, 8], STAMPS[:4]),
    (alterations.noise(1.0), None, STAMPS),
    (alterations.stamped(lambda stamp_ns: stamp_ns + 7), VALUES, [k + 7 for k in STAMPS]),
    (alterations.stamps_frozen(), VALUES, STAMPS[:1] * 6)])
def test_what_arrives(alter, values, stamps):
    packets = arriving(alter)
    assert values in (None, [packet.celsius for packet in packets])
    assert stamps in (None, [packet.stamp_ns for packet in packets])


def test_a_share_is_lost_the_same_every_time():
    many = [Packet(k, float(k)) for k in range(1000)]
    assert 650 < len(arriving(alterations.lost(0.3), many)) < 750
    assert arriving(alterations.lost(0.3), many) == arriving(alterations.lost(0.3), many)


def test_noise_has_the_deviation_asked_for():
    shown = np.array([packet.celsius for packet in arriving(
        alterations.noise(2.0), [Packet(k, 40.0) for k in range(4000)])])
    assert np.mean(shown) == pytest.approx(40.0, abs=0.15)
    assert np.std(shown) == pytest.approx(2.0, rel=0.05)
