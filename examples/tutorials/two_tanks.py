# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # Two tanks from the record of a PLC
#
# Two tanks stand one above the other; a pump fills each, and each drains by gravity, the upper one
# into the lower one. A PLC has recorded both levels and both pump voltages, every 5 s, with noise
# and without derivatives. From its file alone a model is identified, learned, judged by records
# that it has not seen, saved, loaded, and put in control: within limits, and against a leak.
#
# Run the cells one by one in VS Code or Jupyter, or all of them by
# `python examples/tutorials/two_tanks.py [folder]`; pictures and files go to that folder.

# %%
from dataclasses import replace
from pathlib import Path
import sys

import matplotlib.pyplot as plt
import numpy as np

from koopman_ros.control import Controller, InputLimits, SetpointRequest, Tuning
from koopman_ros.core.datasets import Episode, PlantDescription
from koopman_ros.core.plots import draw_limits, DRAWN_RANGE, legend
from koopman_ros.evaluation import at, run_loop
from koopman_ros.learning import evaluate_model, learn_lift, Thresholds
from koopman_ros.learning.identification import identify, WeakForm, WeakFormParameters
from koopman_ros.model import load, save
from koopman_ros.plants import (
    equilibrium_input,
    plant_class,
    Process,
    random_steps,
    RandomStepDesign,
)

# a notebook has arguments of its own
OUT = Path(*[word for word in sys.argv[1:2] if word[0] != '-'] or ['out/tutorials'])
OUT.mkdir(parents=True, exist_ok=True)
LEVELS, PUMPS = ('level_1', 'level_2'), ('pump_1', 'pump_2')
PERIOD, NOISE = 5.0, 5e-4  # s, m

# %% [markdown]
# ## The record
#
# The tanks are simulated here, so that whatever is found can be held against the truth. With tanks
# of your own leave this cell out: you have the file. What matters in it is that the pumps step
# through the range in which the controller is to work, both at the same time and independently.

# %%
constants = plant_class('two_tanks')()
truth = constants.system()
design = RandomStepDesign(
    input_lower=[3.0, 0.0], input_upper=[10.0, 5.0], state_lower=0.03, state_upper=0.28,
    hold_time=(20.0, 60.0), sample_period=PERIOD, rtol=1e-9)
steps = random_steps(truth, design, 2000.0, seed=3)
noise = NOISE * np.random.default_rng(0).standard_normal(steps.x.shape)
record = OUT / 'two_tanks.csv'
np.savetxt(record, np.column_stack([steps.time, steps.x + noise, [*steps.u, steps.u[-1]]])[:-1],
           fmt=['%.0f', *['%.4f'] * 2, *['%.3f'] * 2], delimiter=',', comments='',
           header='time [s],level_1 [m],level_2 [m],pump_1 [V],pump_2 [V]')

# %% [markdown]
# From here on nothing of the tanks is known but the file. Each row has the levels as measured and
# the voltages that act from then on: an `Episode`. Where a record has gaps, make one of each part.

# %%
rows = np.loadtxt(record, delimiter=',', skiprows=1)
time, levels, pumps = rows[:, 0], rows[:, 1:3], rows[:, 3:]
episode = Episode(time, levels, time, pumps)
print(f'{len(episode)} rows, {time[-1] / 60.0:.0f} min; levels from {levels.min():.3f} m to '
      f'{levels.max():.3f} m')

figure, panels = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout='constrained')
for i in range(2):
    panels[0].plot(time / 60.0, levels[:, i], label=LEVELS[i])
    panels[1].step(time / 60.0, pumps[:, i], where='post', label=PUMPS[i])
panels[0].set_ylabel('level [m]')
panels[1].set(ylabel='voltage [V]', xlabel='time [min]')
for panel in panels:
    panel.grid(alpha=0.3)
    panel.legend(loc='upper right')
figure.savefig(OUT / 'two_tanks_record.png')

# %% [markdown]
# ## From the record to a drift
#
# A lift is learned from states and their derivatives, and differentiated noise is noise. So the
# drift f of dx/dt = f(x) + B u is estimated first, as polynomials of several degrees by several
# methods; segments that none of them was fitted to choose one. Nominal point and B are not known:
# NaN and None. (By default `identify` tries more degrees and methods, and takes longer.)

# %%
unknown = np.full(2, np.nan)
plant = PlantDescription('two tanks', LEVELS, ('m', 'm'), PUMPS, ('V', 'V'), 's',
                         nominal_state=unknown, nominal_input=unknown, B=None)
found = identify(plant, [episode], degrees=(1, 2, 3),
                 methods={'weak form': WeakForm(WeakFormParameters((20,)))})
print(f'drift of degree {found.drift.degree}, found by {found.method}')
print(f'noise: {1e3 * found.noise.round(6)} mm, in truth {1e3 * NOISE} mm')
print(f'B:\n{found.drift.input_matrix.round(6)}, in truth\n{truth.B.round(6)} m/(V s)')

# %% [markdown]
# ## From the drift to a lift, and the gate
#
# `learn_lift` samples that drift where the record has been and learns a lift of three coordinates
# from it; `decide` is the gate that the trainer node has, too. On segments that were held out of
# everything the lift must be clearly better than the best linear model, and its law must work in
# closed loops all over the range. The noise is a floor: no model predicts it.

# %%
trained = learn_lift(found, plant, 3, seed=0, starts=1)
decision = evaluate_model(found, trained, None, Thresholds(), loops=16)
for name, error in (('lift', decision.rmse), ('identified drift', decision.drift_rmse),
                    ('best linear model', decision.linear_rmse), ('noise', decision.noise)):
    print(f'{name:18} {1e3 * error[0]:6.2f} mm {1e3 * error[1]:6.2f} mm')
print(f'{"accepted" if decision.accepted else "rejected"}; {decision.law_check}')
for line in (*decision.reasons, *decision.warnings):
    print(line)

# %% [markdown]
# The truth is known here: ten fresh minutes without noise, predicted from their first levels.

# %%
fresh = random_steps(truth, design, 600.0, seed=4)
predicted = trained.model.predict(fresh.x[0], fresh.u, PERIOD)
astray = np.sqrt(np.mean((predicted - fresh.x) ** 2, axis=0))
print(f'prediction of ten fresh minutes: {1e3 * astray.round(6)} mm off')

# %% [markdown]
# ## The model file
#
# The file holds the model with the names, units and ranges of its signals and the steady state
# that it was learned about. It needs no PyTorch to be used.

# %%
file = OUT / 'two_tanks.safetensors'
save(trained.model, file)
model = load(file)
for signals in (model.states, model.inputs):
    for name, unit, center, low, high in zip(
            signals.names, signals.units, signals.center, signals.lower, signals.upper,
            strict=True):
        print(f'{name}: nominal {center:.3f} {unit}, learned from {low:.3f} {unit} to '
              f'{high:.3f} {unit}')

# %% [markdown]
# ## In control
#
# The pumps give 0 to 12 V, and change by at most 2 V/s. Weights are those of squared errors in the
# signals' units: 1 cm of level is worth 1 V here. `observer_bandwidth` is that of the
# disturbance observer, which finds out what the model does not know; 0 leaves it out.

# %%
limits = InputLimits(lower=np.zeros(2), upper=np.full(2, 12.0), rate=np.full(2, 2.0))


def controller(observer_bandwidth):
    """Return the controller of the model, with an observer of some bandwidth in 1/s."""
    return Controller(model, Tuning.for_model(
        model, state_weight=np.full(2, 1.0 / 0.01 ** 2), input_weight=np.ones(2), limits=limits,
        bumpless_transfer_time=30.0, observer_bandwidth=observer_bandwidth))


tanks = Process(truth, 0, truth.nominal_state, truth.nominal_input)

# %% [markdown]
# A set-point that no voltage within the limits holds is rejected, with what would be needed. Here
# the lower tank, into which the upper one drains, is to stand lower than that: its pump would have
# to draw water. So says the true plant, too.

# %%
asked = np.array([0.15, 0.08])
try:
    run_loop(controller(0.1), tanks, [at(PERIOD, SetpointRequest(0, asked))], duration=PERIOD)
except ValueError as rejected:
    rejection = str(rejected)
    print(rejection)
needed = equilibrium_input(truth, asked)
print(f'in truth it takes {needed[0]:.2f} V and {needed[1]:.2f} V')

# %% [markdown]
# One that can be held, and a leak: from 150 s on the outlet of the lower tank is a fifth wider, to
# the model a disturbance. Without the observer it leaves an offset; with it the levels come back,
# and the estimate says how large the leak is, in volts of the lower pump.

# %%
LEAK_AT, GOAL = 150.0, np.array([0.1, 0.15])
leaking = replace(constants, orifice_2=1.2 * constants.orifice_2).system()


def leak(loop):
    """Put the leaking tanks in the place of the others, as they stand."""
    return replace(loop, plant=replace(loop.plant, system=leaking))


events = [at(20.0, SetpointRequest(0, GOAL)), at(LEAK_AT, leak)]
runs = {name: run_loop(controller(bandwidth), tanks, events, duration=400.0, period=PERIOD,
                       noise=np.full(2, NOISE), seed=1)
        for name, bandwidth in (('without observer', 0.0), ('with observer', 0.1))}
offsets = {}
for name, run in runs.items():
    before, after = ((run.times > end - 50.0) & (run.times < end) for end in (LEAK_AT, 400.0))
    offsets[name] = [run.states[part].mean(axis=0) - GOAL for part in (before, after)]
    print(f'{name:17} off before the leak {1e3 * offsets[name][0].round(5)} mm, with it '
          f'{1e3 * offsets[name][1].round(5)} mm')

late = runs['with observer'].reports[-10:]
estimate = np.mean([report.estimate.disturbance for report in late], axis=0)
lost = (leaking.drift(GOAL) - truth.drift(GOAL))[1] / truth.B[1, 1]
print(f'the leak is worth {lost:.2f} V of pump_2, estimated {estimate[1]:.2f} V')

# %%
figure, panels = plt.subplots(4, 1, figsize=(9, 9), sharex=True, layout='constrained')
for i in range(2):
    level, pump = panels[i], panels[2 + i]
    level.axhspan(model.states.lower[i], model.states.upper[i], label='range of the record',
                  **DRAWN_RANGE)
    level.plot([20.0, 400.0], [GOAL[i]] * 2, 'k--', linewidth=1.0, label='set-point')
    draw_limits(pump, (limits.lower[i], limits.upper[i]), 'limits of the pumps')
    for name, run in runs.items():
        level.plot(run.times, run.states[:, i], label=name)
        pump.step(run.times, run.commands[:, i], where='post', label=name)
    level.set_ylabel(f'{LEVELS[i]} [m]')
    pump.set_ylabel(f'{PUMPS[i]} [V]')
for panel in panels:
    panel.axvline(LEAK_AT, color='tab:red', linewidth=1.0, label='leak begins')
    panel.grid(alpha=0.3)
panels[0].set_title('offset of level_2 at the end: ' + ', '.join(
    f'{name} {1e3 * off[1][1]:+.1f} mm' for name, off in offsets.items()), fontsize=9)
panels[3].set(xlabel='time [s]', xlim=(0.0, 400.0))
legend(figure, panels, 6)
figure.savefig(OUT / 'two_tanks_loop.png')

# %% [markdown]
# ## In ROS
#
# The controller node takes the file as it is. The first command starts it for the signals, limits
# and weights that `config/plants/two_tanks.yaml` has for tanks on topics, the second one simulates
# such tanks. A record of the leaking tanks makes the next model:
# [recording and retraining](../../docs/how-to/retrain.md).

# %%
command = (f'ros2 run koopman_ros controller --ros-args -p system:=two_tanks '
           f'-p model:={file.resolve()}')
print(command)
print('ros2 run koopman_ros plant --ros-args -p system:=two_tanks')
