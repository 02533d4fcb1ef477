# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # The pendulum: models of five classes, side by side
#
# A pendulum stands upright, where it falls by itself; a motor in its pivot holds it. Models are
# learned from simulated samples whose rates are exact, so that nothing but the models differs.
# You read the table that compares them, see which one the rule takes and why, try its law in
# closed loops all over the range, and let it hold the pendulum where a linear model is off.
#
# Run the cells one by one in VS Code or Jupyter, or all of them by
# `python examples/tutorials/pendulum.py [folder]`; pictures go to that folder.

# %%
from pathlib import Path
import sys

import matplotlib.pyplot as plt
import numpy as np

from koopman_ros.control import Controller, InputLimits, SetpointRequest, Tuning
from koopman_ros.core.plots import draw_limits, DRAWN_RANGE, legend
from koopman_ros.evaluation import at, evaluate_closed_loops, run_loop
from koopman_ros.learning import compare, IncrementalTraining, NeuralDrift
from koopman_ros.plants import box_episodes, describe, plant_class, Process, RandomStepDesign

# a notebook has arguments of its own
OUT = Path(*[word for word in sys.argv[1:2] if word[0] != '-'] or ['out/tutorials'])
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The plant
#
# Mass m on a rod of length l, angle a from upright, torque u of the motor:
# m l² d²a/dt² = m g l sin a - b da/dt + u. It is a plant of the library; its constants have units.

# %%
constants = plant_class('pendulum')()
system = constants.system()
heaviest = constants.mass * constants.gravity * constants.length
modes = np.sort(np.linalg.eigvals(system.drift_jacobian(system.nominal_state)).real)
print(f'm = {constants.mass} kg, l = {constants.length} m, b = {constants.friction} N m s')
print(f'upright its modes are {modes[0]:.2f}/s and {modes[1]:+.2f}/s: it falls')
print(f'held horizontally it takes m g l = {heaviest:.2f} N m')

# %% [markdown]
# ## Samples
#
# Many short episodes under random steps of the torque, each from another state in a box, a fifth
# of them from its corners. They may leave that box by half of its width: there a loop from a
# corner goes. `box_episodes` simulates them from the equation; states, rates and inputs of your
# own make `DriftSamples(...)` as well.

# %%
corner = np.array([1.2, 4.0])  # rad, rad/s
design = RandomStepDesign(
    input_lower=-10.0, input_upper=10.0, state_lower=-2.0 * corner, state_upper=2.0 * corner,
    hold_time=(0.05, 0.1), sample_period=0.05, rtol=1e-9)
samples = box_episodes(system, design, episodes=70, duration=0.2, seed=3, starts=(-corner, corner))
worst = np.max(np.abs(samples.dxdt - system.derivative(samples.x, samples.u)))
print(f'{len(samples)} samples; their rates differ from the equation by at most {worst:.0e}')

figure, panel = plt.subplots(figsize=(6, 4.5), layout='constrained')
panel.scatter(*samples.x.T, s=6, label='samples')
panel.plot(*(corner * [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]).T, 'k--', linewidth=1.0,
           label='box of the starts')
panel.set(xlabel='angle from upright [rad]', ylabel='rate [rad/s]')
panel.grid(alpha=0.3)
legend(figure, [panel], 2)
figure.savefig(OUT / 'pendulum_samples.png')

# %% [markdown]
# ## The classes side by side
#
# `compare` learns all classes from the same episodes: three fifths to learn from, a fifth to
# choose by (validation), a fifth that nothing else has touched (test). The recipes are small here
# to take seconds; without them the usual ones are learned, from more starts.

# %%
found = compare(describe(system), samples, {
    'neural drift': NeuralDrift(12, max_iterations=150),
    'identity lift': IncrementalTraining(4, hidden_first=8, max_iterations=40),
    'free lift': IncrementalTraining(2, identity=False, hidden_first=8, max_iterations=40)},
    starts=1, loops=8)
print(found)

# %% [markdown]
# How to read it:
#
# - **rx** is the mean-square error of the model's drift beside the size of the drift; those on
#   validation and test episodes should be alike. An `rx` of 1e-2 is an error of a tenth.
# - **roll-out** is what an engineer asks: how far off is the prediction of an episode, in the
#   units of the states?
# - **loops failed** and **cost beside linear** are of the law in closed loops, see below.
# - **remark** says which one was chosen, and why another should not be used.
# - The lifts may read their drift out of the units of the neural drift, too: then they have its
#   `rx`. What makes them lifts, that their coordinates evolve linearly, is measured by `rw`.
#
# The rule: of the models whose law passes, the plainest whose `rx` is at most twice the smallest.
# sin a is no polynomial: higher degrees come closer to it, but a network comes closer still. Where
# the drift is a polynomial, it is the other way round: see `buckled_beam.py`.

# %%
able = [one for one in found.contenders if not one.rejection]
limit = 2.0 * min(one.rx for one in able)
by_hand = next(one for one in able if one.rx <= limit)
print(f'the plainest with rx up to {limit:.1e}: {by_hand.name}; chosen: {found.chosen.name}')
for one in found.contenders:
    if one.figures is not None:
        print(f'{one.name:13} rw {one.figures.fit.rw:.1e}, condition {one.figures.fit.cond:.0f}')

# %% [markdown]
# ## The law, all over the range
#
# A model that predicts well may be no controller. So its law is tried from many states to many
# set-points, on the drift that predicts the validation episodes best, beside the law that knows
# that drift and two linear ones. A loop fails where the law that knows saves 5 %, or alone
# arrives; at most 1 % of the loops may. Where no law arrives, they are tried without limits.
#
# What the motor can do decides more than the model. Below, the same law on the true pendulum with
# weaker motors: set-points are only those that the motor can hold, up to asin(u / m g l), and from
# many a state nothing brings the pendulum back. No model helps there: a narrower range is the
# remedy, or a stronger motor.

# %%
model = found.model
print(f'10 N m: {found.chosen.law_check}; cost relative to a linear law, median '
      f'{found.chosen.law_check.median_ratio:.3f}')
checks = {torque: evaluate_closed_loops(model, system.derivative, loops=16, limits=InputLimits(
    lower=np.array([-torque]), upper=np.array([torque]), rate=np.array([np.inf])))
    for torque in (4.0, 2.0)}
for torque, check in checks.items():
    print(f' {torque:.0f} N m: {check}; from {check.hopeless} of them no law arrives with it; '
          f'set-points up to {np.degrees(np.max(np.abs(check.setpoints[:, 0]))):.1f} degrees, the '
          f'motor holds {np.degrees(np.arcsin(torque / heaviest)):.1f} degrees')

# %% [markdown]
# ## In closed loop
#
# From 0.6 rad on one side to 0.7 rad on the other, within 5 N m, 50 samples a second. Weights are
# those of squared errors, per unit squared: 0.1 rad is worth 1 rad/s and 2 N m. The linear model
# and the chosen one have the same weights and limits; what differs is the torque that each takes
# to hold the set-point.

# %%
torque, goal = 5.0, np.array([0.7, 0.0])
limits = InputLimits(lower=np.array([-torque]), upper=np.array([torque]), rate=np.array([np.inf]))
start = Process(system, 0, np.array([-0.6, 0.0]), np.array([-heaviest * np.sin(-0.6)]))
balance = -heaviest * np.sin(goal[0])
print(f'in truth 0.7 rad takes {balance:.4f} N m')
runs, held = {}, {}
for contender in (found.contenders[0], found.chosen):
    controller = Controller(contender.model, Tuning.for_model(
        contender.model, state_weight=np.array([1.0 / 0.1 ** 2, 1.0]),
        input_weight=np.array([1.0 / 2.0 ** 2]), limits=limits, bumpless_transfer_time=30.0))
    run = run_loop(controller, start, [at(0.1, SetpointRequest(0, goal))], duration=2.0,
                   period=0.02)
    runs[contender.name] = run
    held[contender.name] = run.reports[-1].target.input[0]
    print(f'{contender.name:13} takes {held[contender.name]:.4f} N m and ends '
          f'{run.states[-1, 0] - goal[0]:+.5f} rad off')

# %%
figure, panels = plt.subplots(3, 1, figsize=(8, 7), sharex=True, layout='constrained')
for i, label in enumerate(('angle [rad]', 'rate [rad/s]')):
    panels[i].axhspan(-corner[i], corner[i], label='box of the starts', **DRAWN_RANGE)
    panels[i].set_ylabel(label)
    panels[i].plot([0.1, 2.0], [goal[i]] * 2, 'k--', linewidth=1.0, label='set-point')
draw_limits(panels[2], (-torque, torque), 'limits of the motor')
for name, run in runs.items():
    for i in range(2):
        panels[i].plot(run.times, run.states[:, i], label=name)
    panels[2].step(run.times, run.commands[:, 0], where='post', label=name)
panels[0].set_title('ends off the set-point: ' + ', '.join(
    f'{name} {run.states[-1, 0] - goal[0]:+.1e} rad' for name, run in runs.items()), fontsize=9)
panels[2].set(ylabel='torque [N m]', xlabel='time [s]', xlim=(0.0, 2.0))
for panel in panels:
    panel.grid(alpha=0.3)
legend(figure, panels, 5)
figure.savefig(OUT / 'pendulum_loop.png')
