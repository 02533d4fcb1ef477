# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # A buckled beam: a plant of your own, and a polynomial for it
#
# A steel strip is clamped under pressure, so that it has buckled: its middle rests on either side
# and snaps through when it is pushed far enough. A coil is to hold it anywhere in between. The
# package does not know this plant; you write its equation, weigh its signals in their units, read
# the constants of the equation off the learned model, and see when a polynomial is the model to
# take and when it is not.
#
# Run the cells one by one in VS Code or Jupyter, or all of them by
# `python examples/tutorials/buckled_beam.py [folder]`; the picture goes to that folder.

# %%
from dataclasses import replace
from pathlib import Path
import sys

import matplotlib.pyplot as plt
import numpy as np

from koopman_ros.control import Weights
from koopman_ros.core.plots import draw_limits, DRAWN_RANGE, legend
from koopman_ros.core.solvers import solve_riccati
from koopman_ros.evaluation import run_closed_loop
from koopman_ros.learning import compare, IncrementalTraining, NeuralDrift
from koopman_ros.plants import (
    box_episodes,
    ControlAffineSystem,
    describe,
    equilibrium_input,
    RandomStepDesign,
)

# a notebook has arguments of its own
OUT = Path(*[word for word in sys.argv[1:2] if word[0] != '-'] or ['out/tutorials'])
OUT.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The equation
#
# With x the deflection, v its rate and F the force of the coil:
#
#     dx/dt = v,    dv/dt = k x - h x³ - d v + F / m.
#
# Units are your choice; choose those in which the signals come, here mm, mm/s and N, and put the
# factors between them into B. Functions take states of shape (..., 2). The nominal point must be a
# steady state: the middle, from where the beam falls to either side.

# %%
K, H, D = 400.0, 4.0, 8.0  # 1/s², 1/(mm² s²), 1/s
MASS = 0.1  # kg; 1 N moves it by 10 m/s², which are 10 000 mm/s²


def drift(state):
    """Return dx/dt without the coil: states (..., 2) to rates (..., 2)."""
    x, v = state[..., 0], state[..., 1]
    return np.stack([v, K * x - H * x ** 3 - D * v], axis=-1)


def drift_jacobian(state):
    """Return the derivatives of the drift (..., 2, 2)."""
    x, one = state[..., 0], np.ones(state.shape[:-1])
    return np.stack([np.stack([0.0 * one, one], axis=-1),
                     np.stack([K - 3.0 * H * x ** 2, -D * one], axis=-1)], axis=-2)


beam = ControlAffineSystem(
    name='buckled beam', state_names=('deflection', 'rate'), state_units=('mm', 'mm/s'),
    input_names=('force',), input_units=('N',), time_unit='s', drift=drift,
    drift_jacobian=drift_jacobian, B=np.array([[0.0], [1e3 / MASS]]),
    nominal_state=np.zeros(2), nominal_input=np.zeros(1))
rest = np.sqrt(K / H)
print(f'the beam rests at {-rest:.0f} mm and {rest:.0f} mm; most force is needed at '
      f'{rest / np.sqrt(3.0):.2f} mm')

# %% [markdown]
# ## Samples and models
#
# As in `pendulum.py`: short episodes from all over a box, and the classes side by side. Fewer
# networks are tried here, with small recipes.

# %%
corner, strongest = np.array([12.0, 250.0]), 1.0  # mm and mm/s, N
design = RandomStepDesign(
    input_lower=-strongest, input_upper=strongest, state_lower=-1.4 * corner,
    state_upper=1.4 * corner, hold_time=(0.01, 0.02), sample_period=0.01, rtol=1e-9)
samples = box_episodes(beam, design, episodes=60, duration=0.05, seed=1, starts=(-corner, corner))
recipes = {'neural drift': NeuralDrift(8, max_iterations=100),
           'identity lift': IncrementalTraining(3, hidden_first=8, max_iterations=40)}
found = compare(describe(beam), samples, recipes, starts=1, loops=8)
print(found)

# %% [markdown]
# The polynomial is chosen, and not by chance: the drift is one. Its coefficients follow from one
# linear least-squares problem, whose solution is exact but for rounding; a network can only come
# close. They can be read, too: here they are in the units of the signals.

# %%
model = found.model
monomials, scale = model.observables.exponents, model.states.scale
size = np.prod(scale ** monomials, axis=1)
learned = {tuple(row.tolist()): weight for row, weight in zip(
    monomials, scale[1] * model.A[1] / size, strict=True) if abs(weight) > 1e-6}
for (of_x, of_v), weight in learned.items():
    print(f'dv/dt has {weight:+.9f} x^{of_x} v^{of_v}')

# %% [markdown]
# And the lift? Its drift, which it reads out of its hidden units, is close, too. What makes it a
# lift, that its coordinates evolve linearly, does not hold: `rw` is the share of their motion that
# is not linear. It cannot hold, as this beam rests in three places and a linear system in one. The
# laws on all these models know that, and go by the drift.

# %%
for one in found.contenders:
    if one.figures is not None:
        print(f'{one.name:13} rx {one.figures.fit.rx:.1e}, rw {one.figures.fit.rw:.1e}')

# %% [markdown]
# ## When it is no polynomial
#
# The same beam rubs on a guide: a friction of 3 m/s² that changes its sign with the rate, nearly
# at once. No polynomial has such a bend, and the rule takes another class. You need not know which
# kind of plant yours is: compare, and read the table.

# %%
RUBBING = np.array([0.0, 3000.0])  # mm/s²
rubbing = replace(
    beam, name='rubbing beam',
    drift=lambda state: drift(state) - RUBBING * np.tanh(state[..., 1:] / 30.0),
    drift_jacobian=lambda state: drift_jacobian(state) - np.stack([np.zeros(state.shape), (
        RUBBING / 30.0 / np.cosh(state[..., 1:] / 30.0) ** 2)], axis=-1))
rough = compare(describe(rubbing), box_episodes(
    rubbing, design, episodes=60, duration=0.05, seed=1, starts=(-corner, corner)),
    {'neural drift': recipes['neural drift']}, starts=1, loops=0)
for one in rough.contenders:
    print(f'{one.name:13} rx {one.figures.fit.rx:.1e}'
          + ', chosen' * (one.name == rough.chosen.name))

# %% [markdown]
# ## Weights in the units of the signals
#
# Inside, a model works on scaled deviations, and their scale depends on the samples. Weights
# should not: `Weights.physical` takes them per unit squared. Here 1 mm, 50 mm/s and 0.05 N are
# worth the same. The gain at the middle, in N/mm and N s/mm, is the one of the textbook, from the
# equation.

# %%
per_unit = np.array([1.0, 1.0 / 50.0 ** 2]), np.array([1.0 / 0.05 ** 2])
weights = Weights.physical(model, *per_unit)
scaled = solve_riccati(model.linearised.A, model.B, weights.Q, weights.R).K
gain = model.inputs.scale[:, None] * scaled / model.states.scale
textbook = solve_riccati(drift_jacobian(np.zeros(2)), beam.B, *map(np.diag, per_unit)).K
print(f'gain {gain[0].round(6)}, of the textbook {textbook[0].round(6)}')

# %% [markdown]
# ## In closed loop
#
# From one place of rest to the slope on the other side of the middle, where the beam would snap by
# itself. `run_closed_loop` integrates the true beam under the law in continuous time, without
# limits, and adds up the cost. The linear model takes a wrong force to hold the beam there.

# %%
goal = np.array([-4.0, 0.0])
balance = equilibrium_input(beam, goal)
print(f'in truth {goal[0]:.0f} mm takes {balance[0]:+.4f} N')
loops = {}
for one in (found.contenders[0], found.chosen):
    loops[one.name] = loop = run_closed_loop(
        one.model, beam.derivative, np.array([rest, 0.0]), goal,
        Weights.physical(one.model, *per_unit), duration=0.6, u_ref=balance,
        samples=101, rtol=1e-6)
    print(f'{one.name:10} ends {loop.states[-1, 0] - goal[0]:+.6f} mm off, at '
          f'{loop.inputs[-1, 0]:+.4f} N; cost {loop.cost:.4f}')

# %%
figure, panels = plt.subplots(3, 1, figsize=(8, 7), sharex=True, layout='constrained')
for i, label in enumerate(('deflection [mm]', 'rate [mm/s]')):
    panels[i].axhspan(-corner[i], corner[i], label='box of the starts', **DRAWN_RANGE)
    panels[i].axhline(goal[i], color='black', linestyle='--', linewidth=1.0, label='set-point')
    panels[i].set_ylabel(label)
    for name, loop in loops.items():
        panels[i].plot(loop.times, loop.states[:, i], label=name)
draw_limits(panels[2], (-strongest, strongest), 'range of the samples')
for name, loop in loops.items():
    panels[2].plot(loop.times, loop.inputs[:, 0], label=name)
panels[0].set_title('ends off the set-point: ' + ', '.join(
    f'{name} {loop.states[-1, 0] - goal[0]:+.2g} mm' for name, loop in loops.items()), fontsize=9)
panels[2].set(ylabel='force [N]', xlabel='time [s]', xlim=(0.0, 0.6))
for panel in panels:
    panel.grid(alpha=0.3)
legend(figure, panels, 5)
figure.savefig(OUT / 'buckled_beam.png')

# %% [markdown]
# ## In ROS
#
# For a simulated beam on topics write the equation as a class of constants with a method `system`,
# as [your own plant](../../docs/tutorials/own_plant.md) does; the model file that `save`
# writes is for the controller node, as in `two_tanks.py`.
