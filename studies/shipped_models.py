# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Training of the models that the package ships: lifts of its plants, and the linear reactor.

Run it as ``python -m studies.shipped_models`` (needs the `train` requirements); the seeds are
fixed, so that the same machine writes the same files bit for bit.
"""

from dataclasses import dataclass, replace
from functools import partial
import sys

import numpy as np

from koopman_ros.core.characteristic import Characteristic
from koopman_ros.core.datasets import DriftSamples
from koopman_ros.evaluation.closed_loop_test import LOOPS
from koopman_ros.learning import IncrementalTraining, train
from koopman_ros.model import LiftedModel, linearised_model, Provenance, save
from koopman_ros.plants import (
    Actuator,
    box_episodes,
    ControlAffineSystem,
    describe,
    plant_class,
    random_steps,
    RandomStepDesign,
    ReactorParameters,
)
from koopman_ros.plants.library.heated_line import HeatedLine
from studies.campaign import read_options
from studies.paper.reactor import SYSTEM, TRAINING, training_samples

SEED = 2026
SADDLE = 'two_state_saddle'  # the reactor of two states where it runs away by itself
STARTS = 3
LIFTED_SIZES = (3, 4)


@dataclass(frozen=True)
class Lift:
    """How the lift of a plant of the catalogue is learned: from a box of states, by a recipe."""

    design: RandomStepDesign  #: box, inputs and times, in the plant's units
    episodes: int  #: from random states within the box
    duration: float  #: of each, in the plant's time unit
    recipe: IncrementalTraining  #: a fixed number of steps, as above


# As many free coordinates as states fit all these plants better than identity coordinates (rw by
# two orders and more) but the example, which has an exact lift with them.
_FREE = IncrementalTraining(2, identity=False, hidden_first=16, max_iterations=300, tolerance=0.0)
LIFTS = {
    # about the stable steady state: conversions and temperatures in min, mol/L and K
    'two_state': Lift(RandomStepDesign(
        input_lower=281.0, input_upper=303.0, state_lower=[0.8, 305.0], state_upper=[1.0, 330.0],
        hold_time=(0.5, 1.0), sample_period=0.25), 240, 1.0, _FREE),
    # likewise, the feed between 0.6 and 1.5 of what it is there
    'fed_reactor': Lift(RandomStepDesign(
        input_lower=[60.0, 281.0], input_upper=[150.0, 303.0], state_lower=[0.8, 305.0],
        state_upper=[1.0, 330.0], hold_time=(0.5, 1.0), sample_period=0.25), 240, 1.0, _FREE),
    # the way from (5, 5) to the origin, and its mirror image
    'two_state_example': Lift(RandomStepDesign(
        input_lower=-20.0, input_upper=60.0, state_lower=[-6.0, -6.0], state_upper=[6.0, 8.0],
        hold_time=(0.1, 0.2), sample_period=0.1), 120, 1.0,
        replace(_FREE, n_z=3, identity=True, max_iterations=400)),
    'two_tanks': Lift(RandomStepDesign(
        input_lower=0.0, input_upper=12.0, state_lower=0.02, state_upper=0.25,
        hold_time=(2.0, 5.0), sample_period=1.0), 120, 10.0, _FREE),
    # upper tanks are filled far less than lower ones
    'quadruple_tank': Lift(RandomStepDesign(
        input_lower=0.0, input_upper=8.0, state_lower=[0.04, 0.04, 0.002, 0.002],
        state_upper=[0.25, 0.25, 0.06, 0.06], hold_time=(5.0, 20.0), sample_period=5.0),
        200, 50.0, replace(_FREE, n_z=4, max_iterations=200)),
    # 75 degrees to either side
    'pendulum': Lift(RandomStepDesign(
        input_lower=-12.0, input_upper=12.0, state_lower=[-1.3, -5.0], state_upper=[1.3, 5.0],
        hold_time=(0.05, 0.1), sample_period=0.05), 120, 0.5, _FREE),
}
FEED = 'reactor_feed'  # the reactor of one state, its feed temperature measured
LINE = 'heated_line'
LINE_VALVE = Actuator(0.0, 100.0, dead_time=45.0, rangeability=20.0)
# shares of hot water, and temperatures of the feed in K
LINE_TRAINING = RandomStepDesign(
    input_lower=[2.0, 283.15], input_upper=[98.0, 303.15], state_lower=[0.1, 303.15],
    state_upper=[0.6, 343.15], hold_time=(60.0, 120.0), sample_period=30.0)
NAMES = ('reactor', FEED, LINE, *LIFTS, SADDLE)


def library_system(name: str) -> ControlAffineSystem:
    """Return a plant of the catalogue with its usual constants."""
    system: ControlAffineSystem = plant_class(name)().system()
    return system


def lift_samples(name: str, seed: int) -> DriftSamples:
    """Simulate the episodes that the lift of a plant is learned from."""
    lift = LIFTS[name]
    return box_episodes(library_system(name), lift.design, lift.episodes, lift.duration, seed)


def train_lift(name: str, loops: int = LOOPS) -> LiftedModel:
    """Train the shipped lift of a plant; its metrics are those of held-out episodes."""
    return train(describe(library_system(name)), lift_samples(name, SEED), LIFTS[name].recipe,
                 seed=SEED, starts=1, loops=loops).model


def train_lifts(starts: int = STARTS, loops: int = LOOPS) -> dict[int, LiftedModel]:
    """Train the lifts of the one-state reactor, by n_z; the larger grows from the smaller."""
    # a fixed number of steps: where they end depends least on how a processor rounds
    trained = train(describe(SYSTEM), training_samples(SEED),
                    IncrementalTraining(max(LIFTED_SIZES), tolerance=0.0), seed=SEED,
                    starts=starts, loops=loops)
    return {model.n_z: _with_roll_out(model) for model in trained.path
            if model.n_z in LIFTED_SIZES}


def linear_model(like: LiftedModel) -> LiftedModel:
    """Return the linearisation at the nominal point, with the box of a lift."""
    provenance = Provenance(SYSTEM.name, package_version=like.provenance.package_version)
    return _with_roll_out(linearised_model(
        SYSTEM.drift_jacobian(SYSTEM.nominal_state), SYSTEM.input_matrix(SYSTEM.nominal_state),
        like.states, like.inputs, SYSTEM.time_unit, provenance))


def _with_roll_out(model: LiftedModel) -> LiftedModel:
    """Add the roll-out error, in K, over a fresh episode of random steps to the metrics."""
    truth = random_steps(SYSTEM, TRAINING, 15.0, SEED - 1)
    predicted = model.predict(truth.x[0], truth.u, TRAINING.sample_period)
    error = float(np.sqrt(np.mean((predicted - truth.x) ** 2)))
    metrics = {**model.provenance.metrics, 'rollout_rmse': error}
    return replace(model, provenance=replace(model.provenance, metrics=metrics))


def reactor_models() -> dict[str, LiftedModel]:
    """Train the models of the one-state reactor, by the names of their files."""
    lifts = train_lifts()
    return {**{f'reactor_nz{n_z}': model for n_z, model in lifts.items()},
            'reactor_linear': linear_model(lifts[max(lifts)])}


def with_feed(system: ControlAffineSystem, dilution_rate: float, temperature: float
              ) -> ControlAffineSystem:
    """Return a plant with its feed temperature, which acts on its last state, as an input."""
    gain = np.zeros(system.n_x)
    gain[-1] = dilution_rate
    # B u counts it now
    return replace(
        system, input_names=(*system.input_names, 'feed_temperature'),
        input_units=(*system.input_units, 'K'), drift=lambda x: system.drift(x)
        - temperature * gain, B=np.column_stack(
            [system.input_matrix(system.nominal_state), gain]),
        nominal_input=np.array([*system.nominal_input, temperature]))


def reactor_with_feed() -> ControlAffineSystem:
    """Return the one-state reactor with its feed temperature as a second input."""
    constants = ReactorParameters()
    return with_feed(SYSTEM, constants.dilution_rate, constants.feed_temperature)


def line_with_feed() -> ControlAffineSystem:
    """Return the heated line with its feed temperature as a second input."""
    line = HeatedLine()
    return with_feed(line.system(), line.dilution_rate, line.feed_temperature)


def _fed_lift(system: ControlAffineSystem, samples: DriftSamples, recipe: IncrementalTraining,
              loops: int) -> LiftedModel:
    """Learn a lift, and the effects of the input and of the measured feed temperature."""
    names = ('feed_temperature',)
    plant = replace(describe(system), B=None, disturbance_names=names)
    return train(plant, samples, recipe, seed=SEED, starts=1, loops=loops
                 ).model.with_disturbances(names)


def feed_model(loops: int = LOOPS) -> LiftedModel:
    """Learn a lift of the reactor, and the effects of its coolant and of its feed."""
    samples = box_episodes(reactor_with_feed(), replace(
        TRAINING, input_lower=[281.3, 340.0], input_upper=[301.1, 360.0]), 240, 1.0, SEED)
    return _fed_lift(reactor_with_feed(), samples,
                     IncrementalTraining(max(LIFTED_SIZES), tolerance=0.0), loops)


def line_model(loops: int = LOOPS) -> LiftedModel:
    """Learn a lift of the heated line by the effect of its valve; line and valve are known."""
    samples = box_episodes(line_with_feed(), LINE_TRAINING, 240, 240.0, SEED)
    model = _fed_lift(line_with_feed(), samples, _FREE, loops)
    valve = np.linspace(0.0, 100.0, 41)
    curve, inputs = Characteristic.of(valve, LINE_VALVE.effect(valve)), model.inputs
    return replace(model, dead_time=np.array([LINE_VALVE.dead_time]), inputs=replace(
        inputs, center=curve.value(inputs.center), lower=curve.value(inputs.lower),
        upper=curve.value(inputs.upper), characteristics={'valve': curve}))


def saddle_model() -> LiftedModel:
    """Learn the free lift of the reactor at its saddle."""
    # in here: it imports the systems, and these this module
    from studies.unstable import learn

    return learn(0)


def main(args: list[str] | None = None) -> int:
    """Train shipped models and write them."""
    options = read_options(
        args, 'studies.shipped_models', 'Train the models that the package ships.',
        'config/models', plants=NAMES)
    options.output.mkdir(parents=True, exist_ok=True)
    for plant in options.plants or NAMES:
        own = {SADDLE: saddle_model, FEED: feed_model, LINE: line_model}.get(
            plant, partial(train_lift, plant))
        models = reactor_models() if plant == 'reactor' else {plant: own()}
        for name, model in models.items():
            save(model, options.output / f'{name}.safetensors')
            metrics = ', '.join(f'{key} {value:.2g}'
                                for key, value in model.provenance.metrics.items())
            print(f'{name}: n_z {model.n_z}, seed {model.provenance.seed}, {metrics}', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
