# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Numbers that decide whether a model is accepted."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Thresholds:
    """Settings of the acceptance test; the first two are parameters of a training."""

    #: by this share its held-out error must be smaller than those of the current model, where
    #: there is one, and of the best linear model
    margin: float = 0.1
    #: largest condition number of E[z z'], over that of the states among the coordinates
    condition: float = 1e4
    #: plausible plants: drifts that the record cannot tell from the estimated one
    plants: int = 30
    #: closed loops on each, enough for a share that tells good from bad plants
    plant_loops: int = 16
    #: samples of the loops of one plant, and how few loops a slow plant may have for that; 30
    #: plants then cost about as many samples as a test of one drift with 128 loops
    plant_calls: int = 3200
    fewest_loops: int = 4
    #: largest share of failing loops on the plant, by its upper bound
    most_failing: float = 0.05
    confidence: float = 0.95  #: of that bound, and of the band of the rate
    #: a plant counts as lost if more than this share of its loops fail
    lost_share: float = 0.25
    lost_plants: int = 4  #: lost plants that end the test
    #: degree of the corrections of the rate, in states and inputs together; kinks of an input,
    #: such as a dead zone, need at least 5
    degree: int = 5
    degree_of_one_state: int = 8  #: the same of a plant with one state, which has few terms
    most_coefficients: int = 400  #: of all corrections; the degree is reduced to so many
    #: numbers of the sensitivities in memory (8 bytes each); of a longer record some segments
    most_numbers: int = 20_000_000
    #: prior deviation of the drift's own terms, in units of its rate: flat, the usual covariance
    own_deviation: float = 3.0
    #: prior deviations of the other terms: tau q^(degree - 2), integrated over a grid of tau from
    #: this value to 1, and of q
    least_deviation: float = 1e-4
    deviations: int = 13  #: values of tau
    decays: tuple[float, ...] = (0.35, 0.6, 1.0)  #: values of q
    noise_rounds: int = 6  #: estimates of noise and corrections in turn; they settle after four
    #: autocorrelations of the residuals below the first count as 0, above the second as this
    autocorrelation: tuple[float, float] = (0.05, 0.98)
    #: least standard deviation of the noise, in scaled deviations: an exactly known signal
    least_noise: float = 1e-6
    #: samples of the shortest piece of a record; longer free runs may err by at most this factor
    #: more: beyond, they do not depend linearly on a correction of the rate
    shortest_piece: int = 20
    growth: float = 4.0
    largest_residual: float = 3.0  #: in scaled deviations; a piece with a larger one is left out
    fewest_used: float = 0.5  #: least share of the pieces that the free runs have to follow
    #: a group of corrections is named as the cause above this share of the motion
    noticeable_cause: float = 0.02
    #: shares at either end of the recorded values that do not count for a range
    trimmed: float = 0.005
    held_points: int = 21  #: values of a range at which a steady state is searched for
    #: least share of the recorded range of one state, and of requested set-points, to be held
    least_held: float = 0.5
    band_points: int = 40  #: states on the picture of the band
    #: other drifts of the identification that are plausible plants, at most
    alternatives: int = 5
    #: an error is more than noise if it is this unlikely, in standard deviations, and this large
    #: relative to the range
    sigmas: float = 5.0
    noticeable: float = 1e-3
    #: autocorrelation above which noise is coloured; that of a fitted start stays far below
    coloured: float = 0.3
    #: share of the range of set-points that may be missing: noise moves the ends of a record
    missing_range: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 <= self.margin < 1.0:
            raise ValueError(f'margin = {self.margin} must be in [0, 1)')
        if not self.condition > 1.0:
            raise ValueError(f'condition = {self.condition} must be above 1')


#: the settings where a training gives no others
DEFAULTS = Thresholds()
