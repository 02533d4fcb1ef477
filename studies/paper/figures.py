# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of the paper's results, one file each."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from koopman_ros.core.plots import drawing, DRAWN_RANGE, legend, LIMIT, Picture
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
FIGURE_SEED = 0
_loops: dict[int, ClosedLoop] = {}  # by the identity of the model, which the campaign keeps
FIGURE_NARROW_BOX = '[4,5.5]x[4,5.5]'


def draw_figures(campaign: Campaign, folder: Path) -> list[Picture]:
    """Draw every figure whose experiment has been run; return them in the paper's order."""
    drawn = []
    for name, experiments, draw in (
            ('01_scalar_example', ('scalar',), _scalar),
            ('02_two_state_derivatives', ('two_state',), partial(_both_derivatives, 'wide')),
            ('03_two_state_control', ('two_state',), partial(_both_control, 'wide')),
            ('04_reactor_in_range', ('reactor',), partial(_roll_outs, reactor.IN_RANGE, 'within')),
            ('05_reactor_out_of_range', ('reactor',), partial(
                _roll_outs, reactor.OUT_OF_RANGE, 'that leave')),
            ('06_reactor_set_point', ('reactor',), _set_point),
            ('07_wide_box', ('two_state',), partial(_boxes_of, ('wide',))),
            ('08_narrow_derivatives', ('narrow',), partial(_both_derivatives, 'narrow')),
            ('09_narrow_control', ('narrow', 'two_state'), partial(_both_control, 'narrow')),
            ('10_narrow_box', ('narrow',), partial(_boxes_of, ('narrow',))),
            ('11_both_boxes', ('narrow', 'two_state'), partial(_boxes_of, ('wide', 'narrow'))),
            ('12_sensors', ('sensors/noisy', 'sensors/noise_free', 'sensors/drifted',
                            'sensors/two_state'), _sensors)):
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


def _loop(model: LiftedModel) -> ClosedLoop:
    """Regulate the two-state example with R = 1 by one of the models, once for all figures."""
    if id(model) not in _loops:
        _loops[id(model)] = two_state.close_loop(model, 1.0)
    return _loops[id(model)]


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


def _derivatives(model: LiftedModel, box: two_state.StateRange, path: Path) -> float:
    """Draw both sides of the lifted dynamics; return the largest relative difference."""
    # one training trajectory that is long enough to look at
    episode = two_state.samples(box, FIGURE_SEED, episodes=1, duration=3.0)
    assert episode.time is not None
    push = model.inputs.to_deviation(episode.u) @ model.B.T
    z, J = model.lift_and_jacobian(model.states.to_deviation(episode.x))
    exact = (J @ (episode.dxdt / model.states.scale)[..., None])[..., 0]
    linear = z @ model.A.T + (J @ push[..., None])[..., 0]
    with drawing(path, 3, 1, size=(7.0, 6.5), sharex=True) as (_, axes):
        for i, axis in enumerate(axes):
            axis.step(episode.time, exact[:, i], where='post',
                      label='chain rule  $J_N(x)\\,\\dot x$', **EXACT)
            axis.step(episode.time, linear[:, i], where='post',
                      label='learned  $A z + J_N(x) B u$', **_LIFTED)
            axis.set(ylabel=f'dz$_{i + 1}$/dt  [1/s]')
        axes[0].legend(loc='best')
        axes[-1].set(xlabel='time  [s]')
    return float(np.max(np.abs(exact - linear)) / np.max(np.abs(exact)))


def _both_derivatives(where: str, campaign: Campaign, path: Path) -> str:
    seed, model = _lift(campaign, where)
    box = two_state.WIDE if where == 'wide' else two_state.NARROW[FIGURE_NARROW_BOX]
    off = _derivatives(model, box, path)
    return (f'Rates of the lifted coordinates along a training trajectory in the {where} box, '
            f'seed {seed}; the two sides differ by at most {off:.1e} of the largest.')


def _control(campaign: Campaign, path: Path, label: str, learned: LiftedModel
             ) -> tuple[ClosedLoop, ...]:
    """Draw the control by a learned lift, by linearisation and by the exact lift."""
    linear = _model(campaign, 'two_state', 'linear')
    loops = _loop(linear), two_state.exact_loop(1.0), _loop(learned)
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


def _boxes(path: Path,
           parts: Sequence[tuple[str, str, two_state.StateRange, ClosedLoop, str]]) -> None:
    """
    Draw boxes over (x1, x2, u) with the closed-loop paths that their lifts give.

    :param parts: label, face colour, box, path, colour of the path.
    """
    with drawing(path, size=(7.5, 6.0), grid=False,
                 subplot_kw={'projection': '3d'}) as (figure, panels):
        axes: Any = panels[0]
        for label, face, box, loop, color in parts:
            lower = np.array([*box.lower, box.inputs[0]])
            axes.bar3d(*lower, *(np.array([*box.upper, box.inputs[1]]) - lower), shade=False,
                       color=(face, 0.0 if face == 'white' else 0.2), edgecolor='black',
                       linewidth=0.8, linestyle='--' if face == 'white' else '-', label=label)
            points = np.column_stack([loop.states, loop.inputs])
            # what escapes would shrink the boxes to a point
            points = points[np.all(np.abs(points) < 80.0, axis=1)]
            axes.plot(*points.T, color=color, linewidth=2.0, label=f'path with the {label}')
            axes.scatter(*points[0], color=color, s=30)
        axes.scatter(0.0, 0.0, 0.0, color='black', marker='x', s=40, label='origin')
        axes.set(xlabel='x$_1$', ylabel='x$_2$', zlabel='u  [1/s]')
        axes.view_init(elev=22.0, azim=-60.0)
        legend(figure, [axes], 3)


def _boxes_of(where: tuple[str, ...], campaign: Campaign, path: Path) -> str:
    lifts = {name: _lift(campaign, name) for name in where}
    boxes = {'wide': two_state.WIDE, 'narrow': two_state.NARROW[FIGURE_NARROW_BOX]}
    colors = {'wide': ('gold', 'tab:green'), 'narrow': ('grey', 'tab:red')}
    loops = {name: _loop(model) for name, (_, model) in lifts.items()}
    _boxes(path, [(f'{name} box', 'white' if name == 'wide' and len(where) > 1 else
                   colors[name][0], boxes[name], loops[name], colors[name][1])
                  for name in where])
    left = ', '.join(f'that of the {name} box by {max(0.0, loops[name].distance(model)):.2g}'
                     for name, (_, model) in lifts.items())
    return ('Training boxes and the paths of the controlled system, which leave them by up to '
            f'these half-ranges: {left}.')


def _sensors(campaign: Campaign, path: Path) -> str:
    def values(experiment: str, name: str) -> list[float]:
        found = campaign.metrics[f'sensors/{experiment}']
        return [float(found[seed][name]) for seed in sorted(found)]  # type: ignore[arg-type]

    before = np.array(values('drifted', 'offset_before_kelvin'))
    with drawing(path, 1, 3, size=(12.0, 4.2)) as (_, (left, middle, right)):
        for axes, title, ylabel, shown in (
                (left, 'an hour of data', 'roll-out error [K]', (
                    ('noisy', 'rollout_kelvin', 'noise of 0.1 K', 'tab:blue'),
                    ('noise_free', 'rollout_kelvin', 'no noise', 'tab:green'))),
                (middle, 'cooling jacket fouled', 'offset from the set-point [K]', (
                    ('drifted', 'offset_before_kelvin', 'present lift', 'tab:red'),
                    ('drifted', 'offset_after_kelvin', 'new lift', 'tab:green'))),
                (right, 'one temperature of two states', 'error on held-out measurements [K]', (
                    ('two_state', 'linear_kelvin', 'best linear model', 'tab:red'),
                    ('two_state', 'heldout_kelvin', 'lift', 'tab:blue'),
                    ('two_state', 'noise_kelvin', 'noise', '0.5')))):
            for experiment, name, label, color in shown:
                axes.plot(values(experiment, name), 'o', color=color, label=label)
            axes.set(title=title, xlabel='seed', ylabel=ylabel)
        for bound, label, style in ((0.05, 'noisy', ':'), (0.01, 'no noise', '--')):
            left.axhline(bound, label=f'held to, {label}', **{**LIMIT, 'linestyle': style})
        middle.plot(before / 20.0, '_', color='0.4', markersize=12, label='held to: a 20th')
        left.set_yscale('log')
        middle.set_yscale('log')
        right.set_ylim(0.0, None)
        for axes in (left, middle, right):
            axes.legend(fontsize=8)
    worst = max(values('noisy', 'rollout_kelvin'))
    return (f'Lifts learned from a sensor: with noise of 0.1 K the worst of {len(before)} seeds '
            f'predicts to {worst:.2g} K; after fouling the largest offset left is '
            f'{max(values("drifted", "offset_after_kelvin")):.2g} K; where a state is not '
            'measured the error stays above the noise.')
