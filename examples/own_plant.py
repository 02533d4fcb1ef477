# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Two tanks in series, a plant that is not part of the package: learned, saved and controlled.

Run it as ``python examples/own_plant.py [model file]``; docs/own_plant.md walks through it.
"""

from dataclasses import replace
import sys

import numpy as np

from koopman_ros.control import run_closed_loop, Weights
from koopman_ros.learning import Edmd, evaluate, Growth, Linearisation, train
from koopman_ros.lifting import Box, load, save
from koopman_ros.plant_data import Plant, Samples, split_by_episode

PLANT = Plant(
    name='two tanks', state_names=('upper', 'lower'), state_units=('m', 'm'),
    input_names=('inflow',), input_units=('L/min',), time_unit='min',
    nominal_state=np.array([1.0, 1.0]), nominal_input=np.array([20.0]),
    B=np.array([[1.0 / 100.0], [0.0]]))


def rate(levels, inflow):
    """Return the rates of both levels (..., 2), in m/min, under an inflow (..., 1), in L/min."""
    outflow = 20.0 * np.sqrt(levels)
    return np.stack([(inflow[..., 0] - outflow[..., 0]) / 100.0,
                     (outflow[..., 0] - outflow[..., 1]) / 140.0], axis=-1)


def record(episodes, minutes, seed):
    """Simulate episodes under an inflow that steps every minute, levels between 0.2 and 1.8 m."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0.2, 1.8, (episodes, 2))
    x[::5] = rng.choice([0.2, 1.8], (len(x[::5]), 2))  # every fifth starts in a corner
    u = 20.0 * np.sqrt(rng.uniform(0.2, 1.8, (minutes, episodes, 1)))
    states = np.empty((minutes, episodes, 2))
    for k in range(minutes):
        states[k] = x
        for _ in range(10):  # Runge-Kutta steps of 0.1 min
            k1 = rate(x, u[k])
            k2 = rate(x + 0.05 * k1, u[k])
            k3 = rate(x + 0.05 * k2, u[k])
            x = x + 0.1 / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + 0.1 * k3, u[k]))
    time, episode = np.divmod(np.arange(minutes * episodes), episodes)
    states, u = states.reshape(-1, 2), u.reshape(-1, 1)
    return Samples(x=states, dxdt=rate(states, u), u=u, episode=episode, time=1.0 * time)


def main(file):
    """Learn, compare, save, load and control."""
    samples = record(episodes=80, minutes=10, seed=1)
    recipe = Growth(n_z=5, hidden_first=16, max_iterations=300)
    trained = train(PLANT, samples, recipe, starts=1)
    free = train(PLANT, samples, replace(recipe, n_z=2, identity=False), starts=1)
    save(free.model, file)

    known, _, test = split_by_episode(samples, seed=0)
    box = Box.of(PLANT, samples.x, samples.u)
    slope = np.array([[-0.1, 0.0], [10.0 / 140.0, -10.0 / 140.0]])  # of the rates, at 1 m
    models = {'linearised': Linearisation(slope).learn(PLANT, samples, box)}
    models |= {f'EDMD, degree {degree}': Edmd(degree).learn(PLANT, known, box)
               for degree in (3, 5)}
    models |= {f'lift, n_z = {model.n_z}': model for model in trained.path}
    models['free, n_z = 2'] = load(file)
    goal, inflow = np.array([0.3, 0.3]), 20.0 * np.sqrt([0.3])
    weights = Weights(Q=np.eye(2), R=np.eye(1))
    print('                      rw       rx     cond  roll-out, mm   cost  offset, mm')
    for name, model in models.items():
        figures = evaluate(model, test)
        loop = run_closed_loop(model, rate, PLANT.nominal_state, goal, weights, duration=120.0,
                               u_ref=inflow)
        print(f'{name:15} {figures.fit.rw:8.1e} {figures.fit.rx:8.1e} {figures.fit.cond:8.3g}'
              f' {1e3 * figures.rollout_rmse[1]:13.3f} {loop.cost:6.2f}'
              f' {1e3 * abs(loop.states[-1, 1] - goal[1]):11.3f}')


if __name__ == '__main__':
    main(sys.argv[1] if len(sys.argv) > 1 else 'two_tanks.safetensors')
