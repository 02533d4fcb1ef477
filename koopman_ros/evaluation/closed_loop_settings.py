# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The closed loops of a test: their number and duration, and when a law has failed."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ClosedLoopSettings:
    """
    Settings of the test of a law in closed loops.

    Lengths are in scaled deviations, of which 1 is the scale of a signal.
    """

    loops: int = 128  #: closed loops that a law is judged by
    #: a law is poor if its cost exceeds that of a linear one by more than this factor
    most_cost: float = 1.1
    #: and fails if its cost exceeds that with a perfect model by more than this factor
    most_excess: float = 1.05
    most_failures: float = 0.01  #: share of the closed loops that may fail
    attempts: int = 4  #: steady states that are sought for each set-point
    apart: float = 0.25  #: least distance of a start from its set-point
    #: share of the steady states that are set-points although none is where the data are
    nearest: float = 0.1
    duration: float = 6.0  #: of a loop, in slowest time constants of the linear loop
    slowest: float = 1e-3  #: slowest rate that is waited for, relative to the fastest
    samples: int = 2  #: in the fastest time constant of the linear loop
    steps: int = 8  #: of integration in that time constant
    #: samples of all loops together; a slow plant takes many, and fewer loops then
    most_calls: int = 19200
    fewest_loops: int = 16  #: however many samples they take
    #: loops that are run side by side, the same ones wherever that is: sums depend on how many
    part: int = 32
    arrived: float = 0.05  #: largest distance from the set-point at the end of a loop
    escaped: float = 10.0  #: distance from the nominal point at which a loop is lost
    patience: int = 4  #: usual durations that a loop may last when only some laws have arrived
    kept: float = 0.1  #: share of the inputs' range, at either end, kept from a perfect model
    largest_gain: float = 1e6  #: of a law without a tuning
    resolution: float = 1e-9  #: remainder of an input, a distance or a step that counts as 0
    rounded: float = 1e-3  #: share of the trained range to which failed starts are stated


#: the settings of acceptance, training and tests
SETTINGS = ClosedLoopSettings()
