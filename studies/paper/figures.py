# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of the paper's results, one file each."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.core.plots import drawing, DRAWN_RANGE, LIMIT, Picture
from koopman_ros.evaluation import ClosedLoop
from koopman_ros.model import LiftedModel
from koopman_ros.plants import RandomStepDesign
from studies.campaign import Campaign
from studies.paper import reactor, scalar, two_state

# The paper's colours.
EXACT: dict[str, Any] = {'color': 'black', 'linewidth': 1.8}
LEARNED: dict[str, Any] = {'color': 'tab:green', 'linestyle': '--', 'linewidth': 1.8}
LINEAR: dict[str, Any] = {'color': 'tab:red', 'linewidth': 1.2}
_LIFTED: dict[str, Any] = {'color': 'tab:red', 'linestyle': '--', 'linewidth': 1.8}
FIGURE_NARROW_BOX = '[4,5.5]x[4,5.5]'


def draw_figures(campaign: Campaign, folder: Path) -> list[Picture]:
    """Draw every figure whose experiment has been run; return them in the paper's order."""
    drawn = []
    for name, experiments, draw in (
            ('01_scalar_example', ('scalar',), _scalar),
            ('02_two_state_control', ('two_state',), partial(_both_control, 'wide')),
            ('03_reactor_in_range', ('reactor',), partial(_roll_outs, reactor.IN_RANGE, 'within')),
            ('04_reactor_out_of_range', ('reactor',), partial(
                _roll_outs, reactor.OUT_OF_RANGE, 'that leave')),
            ('05_reactor_set_point', ('reactor',), _set_point),
            ('06_narrow_control', ('narrow', 'two_state'), partial(_both_control, 'narrow'))):
        if all(name in campaign.models for name in experiments):
            caption = draw(campaign, folder / f'{name}.png')
            drawn.append(Picture(f'{name}.png', caption))
    return drawn


def _model(campaign: Campaign, experiment: str, name: str) -> LiftedModel:
    """Return a model of the first seed that was finished."""
    by_seed = campaign.models[experiment]
    return by_seed[min(by_seed)][name]


def worst_narrow(campaign: Campaign) -> tuple[int, LiftedModel]:
    """Return the seed whose narrow lift controls worst among those that go on to the end."""
    def badness(seed: int) -> float:
        end = campaign.metrics['narrow'][seed][f'{FIGURE_NARROW_BOX}/final_distance']
        return -1.0 if end is None else float(end)  # type: ignore[arg-type]

    seed = max(sorted(campaign.models['narrow']), key=badness)
    return seed, campaign.models['narrow'][seed][FIGURE_NARROW_BOX]


def _lift(campaign: Campaign, where: str) -> tuple[int, LiftedModel]:
    """Return seed and lift of the wide box, or of the narrow one."""
    if where == 'narrow':
        return worst_narrow(campaign)
    return min(campaign.models['two_state']), _model(campaign, 'two_state', 'wide')


def _scalar(campaign: Campaign, path: Path) -> str:
    model = _model(campaign, 'scalar', 'scalar')
    x = np.linspace(0.0, 8.0, 801)
    at = 2.5
    # within these bounds the tangent is within 10 % of x^2
    reach = np.array([1.0 / (1.0 + np.sqrt(0.1)), 1.0 / (1.0 - np.sqrt(0.1))]) * at
    z, J = model.lift_and_jacobian(model.states.to_deviation(x[:, None]))
    exact = (J[:, :, 0] * (x * x)[:, None] / model.states.scale)[:, 0]
    linear = (z @ model.A.T)[:, 0]
    scale = 1.0 / np.max(np.abs(exact[x <= 5.0]))
    with drawing(path, 1, 2, size=(10.0, 4.3)) as (_, (left, right)):
        for axes in (left, right):
            axes.axvspan(*scalar.RANGE, label='training range', **DRAWN_RANGE)
            axes.set(xlabel='x', xlim=(0.0, 8.0))
        left.plot(x, x * x, color='tab:blue', label='$\\dot x = x^2$')
        left.plot(x, at * at + 2.0 * at * (x - at), label='linearisation', **LINEAR)
        left.plot([at], [at * at], 'o', color='tab:red', label='operating point')
        for bound, label in zip(reach, ('linearisation within 10 %', None), strict=True):
            left.axvline(bound, color='tab:red', linestyle='--', linewidth=1.0, label=label)
        left.set(ylabel='dx/dt  [1/s]', ylim=(-6.0, 66.0))
        left.legend(loc='upper left')
        right.plot(x, scale * exact, label='chain rule  $J_N(x)\\,\\dot x$', **EXACT)
        right.plot(x, scale * linear, label='learned  $A\\,N(x)$', **_LIFTED)
        right.set(ylabel='dz/dt  (largest in range = 1)')
        right.legend(loc='lower right')
    off = abs(exact[-1] - linear[-1]) / abs(exact[-1])
    return ('The motivating example. The learned lift holds on the whole training range, the '
            f'linearisation from x = {reach[0]:.2g} to {reach[1]:.2g}. At x = 8, outside the '
            f'range, A z is {100 * off:.2g} % off.')


def _control(campaign: Campaign, path: Path, label: str, learned: LiftedModel
             ) -> tuple[ClosedLoop, ...]:
    """Draw the control by a learned lift, by linearisation and by the exact lift."""
    linear = _model(campaign, 'two_state', 'linear')
    loops = (two_state.close_loop(linear, 1.0), two_state.exact_loop(1.0),
             two_state.close_loop(learned, 1.0))
    with drawing(path, 1, 2, size=(10.0, 4.0)) as (_, (state, action)):
        for name, style, loop in zip(('linearisation', 'exact lift', label),
                                     (LINEAR, EXACT, LEARNED), loops, strict=True):
            state.plot(loop.times, loop.states[:, 1], label=name, **style)
            action.plot(loop.times, loop.inputs[:, 0], label=name, **style)
        state.axhline(0.0, label='reference', **LIMIT)
        for axes, ylabel in ((state, 'unstable state x$_2$'), (action, 'control action u  [1/s]')):
            axes.set(xlabel='time  [s]', ylabel=ylabel, xlim=(-0.6, 30.0))
        state.legend()
    return loops


def _both_control(where: str, campaign: Campaign, path: Path) -> str:
    seed, model = _lift(campaign, where)
    linear, exact, learned = _control(campaign, path, f'lift of the {where} box', model)
    end = learned.failure or f'{learned.cost:.2f}'
    return (f'Control of the two-state example from (5, 5), R = 1, by a lift of the {where} box, '
            f'seed {seed}. Costs: exact {exact.cost:.2f}, learned {end}, linearised '
            f'{linear.cost:.2f}.')


def _roll_outs(design: RandomStepDesign, where: str, campaign: Campaign, path: Path) -> str:
    models = {name: _model(campaign, 'reactor', name) for name in ('nz=3', 'linear')}
    states, inputs = models['nz=3'].states, models['nz=3'].inputs
    truth = reactor.random_steps_of(design, 1, 60.0, 77)
    assert truth.time is not None
    errors = {}
    with drawing(path, 2, 1, size=(8.0, 5.5), sharex=True, height_ratios=(3, 1)
                 ) as (_, (top, low)):
        top.axhspan(states.lower[0], states.upper[0], label='training range', **DRAWN_RANGE)
        top.plot(truth.time, truth.x[:, 0], label='reactor', **EXACT)
        for name, label, style in (('nz=3', 'learned lift, n$_z$ = 3', LEARNED),
                                   ('linear', 'linearisation', LINEAR)):
            predicted = models[name].predict(truth.x[0], truth.u[:-1], np.diff(truth.time))
            errors[name] = float(np.sqrt(np.mean((predicted - truth.x) ** 2)))
            top.plot(truth.time, predicted[:, 0], label=label, **style)
        top.set(ylabel='temperature  [K]')
        top.legend(loc='best', ncols=2)
        low.axhspan(inputs.lower[0], inputs.upper[0], **DRAWN_RANGE)
        low.step(truth.time, truth.u[:, 0], where='post', color='tab:blue')
        low.set(ylabel='coolant  [K]', xlabel='time  [min]')
    return (f'Fresh random coolant steps {where} the training range; root mean square error: '
            f'learned {errors["nz=3"]:.2g} K, linearised {errors["linear"]:.2g} K.')


def _set_point(campaign: Campaign, path: Path) -> str:
    offsets = {}
    with drawing(path, 2, 1, size=(7.0, 5.5), sharex=True) as (_, (top, low)):
        top.axhline(reactor.SETPOINT, label='set-point T$_{ss}$ − 10 K', **LIMIT)
        for name, label, style in (
                ('linear', 'linearisation', LINEAR),
                ('nz=3', 'learned lift, n$_z$ = 3', {**LEARNED, 'linestyle': '-'})):
            loop = reactor.close_loop(_model(campaign, 'reactor', name))
            offsets[name] = abs(loop.states[-1, 0] - reactor.SETPOINT)
            top.plot(loop.times, loop.states[:, 0], label=label, **style)
            low.plot(loop.times, loop.inputs[:, 0], label=label, **style)
        top.set(ylabel='temperature  [K]')
        low.set(ylabel='coolant  [K]', xlabel='time  [min]', xlim=(0.0, 10.0))
        top.legend()
    return ('Set-point tracking to T_ss - 10 K, R = 1: the learned lift ends '
            f'{offsets["nz=3"]:.1e} K off, the linearised controller {offsets["linear"]:.3f} K.')
