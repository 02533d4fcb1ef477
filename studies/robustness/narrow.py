# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Lifts of too narrow data used outside them, without fallback and with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from koopman_ros import control, evaluation
from koopman_ros.control import Controller
from koopman_ros.evaluation import at, LoopRun
from koopman_ros.learning import IncrementalTraining, train
from koopman_ros.plants import box_episodes, describe, RandomStepDesign
from studies.campaign import Metrics
from studies.robustness import loop
from studies.robustness.loop import REACTOR, START

HALF_WIDTH = 1.5  # K
# Coolant and reactor in K, times in min.
DESIGN = RandomStepDesign(
    input_lower=295.0, input_upper=305.0, state_lower=START - HALF_WIDTH,
    state_upper=START + HALF_WIDTH, hold_time=(0.1, 0.25), sample_period=0.05, max_redraws=20)
SECONDS = 1200.0
LINEAR_MARGINS, MARGIN_BANDWIDTHS = (0.2, 0.5, 1.0), (0.0, 2.0, 6.0)
_DISTURBED = 60.0  # s


@dataclass(frozen=True)
class Trial:
    """A task for a lift of narrow data."""

    name: str  #: for the tables
    temperature: float  #: of the reactor at the start, in K
    bandwidth: float = loop.BANDWIDTH  #: of the observer, in 1/min
    changes: Sequence[evaluation.ScheduledChange] = ()  #: events with their times, in s

    def run(self, controller: Controller) -> LoopRun:
        """Drive the true reactor to its steady state."""
        return loop.run_loop(
            controller, REACTOR, SECONDS, [at(0.0, loop.at_setpoint(START)), *self.changes],
            x0=[self.temperature], coolant=loop.COOLANT, stop=lambda x, *_: bool(x[0] > 420.0))


TRIALS = (
    Trial('start at 338 K', 338.0),
    Trial('UA −40 % after 1 min, no observer', START, 0.0,
          (at(_DISTURBED, loop.on_plant(system=loop.changed_reactor(heat_transfer=0.6))),)),
    Trial('start at 300 K', 300.0))


def reactor_courses() -> dict[tuple[str, str], LoopRun]:
    """Run all trials: by their name and ``narrow``, ``guarded`` (with fallback) or ``wide``."""
    # an hour of steps within 1.5 K of the steady state
    samples = box_episodes(REACTOR, DESIGN, 60, 1.0, 0)
    lift = train(describe(REACTOR), samples, IncrementalTraining(3), seed=0, starts=1,
                 reject=False).model
    return {(trial.name, kind): trial.run(loop.reactor_controller(
        bandwidth=trial.bandwidth, fallback=fallback, model=model)) for trial in TRIALS
        for kind, model, fallback in (('narrow', lift, False), ('guarded', lift, True),
                                      ('wide', None, True))}


def judge_reactor(course: LoopRun, since: float = 0.0) -> Metrics:
    """Return the result of a trial; it ran away above 350 K, and time counts from `since` s on."""
    hottest = float(np.max(course.states))
    return {'hottest_kelvin': hottest, 'final_kelvin': float(course.states[-1, 0]),
            'seconds_to_0.2_kelvin': loop.settling(course, START, 0.2, since),
            'ran_away': bool(course.failure) or hottest > 350.0,
            'safe_share': float(np.mean([level == control.SAFE for level in course.levels]))}


def far_from_the_model(linear_model_margin: float, bandwidth: float) -> Metrics:
    """Judge the loop with the shipped lift after it has lost 40 % of UA, from then on."""
    controller = loop.reactor_controller(bandwidth=bandwidth,
                                         linear_model_margin=linear_model_margin)
    return judge_reactor(TRIALS[1].run(controller), _DISTURBED)
