# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Choice of a drift model on held-out segments."""

from dataclasses import replace
import signal
import sys

import numpy as np
import pytest

from koopman_ros.control.experiment import Experiment
from koopman_ros.core.datasets import cut, Episode, PlantDescription
from koopman_ros.core.integration import runge_kutta_step
from koopman_ros.learning.identification import (
    identify,
    longest_step,
    methods_of,
    Segments,
    Stopped,
)
from support.known_plants import CUBIC, methods, PAIR

NOISE = 0.02
LEVELS = ('level_1', 'level_2', 'level_3')


@pytest.fixture(scope='module')
def noisy():
    return CUBIC.excited(600, 0.1, noise=NOISE)


@pytest.fixture(scope='module')
def found(noisy):
    return identify(CUBIC.plant, [noisy], degrees=(1, 3, 4), methods=methods(10, 20))


def test_takes_output_error_and_the_right_degree(found):
    assert found.method.startswith('output error from ')
    assert found.drift.degree == 3
    assert found.linear.degree == 1
    # that of degree 4 explains it as well
    assert [one.degree for one in found.alternatives] == [4]
    # 480 samples with noise of 2 % of the range: see the bound in test_estimates
    assert CUBIC.misfit(found.drift) < 5.0 * np.sqrt(5.0) * NOISE / np.sqrt(480.0)
    assert found.drift.input_matrix == pytest.approx(CUBIC.B, rel=5e-3)
    assert found.noise == pytest.approx([NOISE], rel=0.1)


def test_scores_list_all_candidates(found):
    assert [(score.degree, score.method.split(' from')[0]) for score in found.scores] == [
        (degree, method) for degree in (1, 3, 4) for method in (
            'weak form, 10 samples', 'weak form, 20 samples', 'total variation', 'output error')]
    scale = found.drift.box.states.scale
    for score in found.scores:
        assert score.cost == pytest.approx(float(np.mean((score.rmse / scale) ** 2)))
    cubic = [score.rmse[0] for score in found.scores if score.degree == 3]
    linear = [score.rmse[0] for score in found.scores if score.degree == 1]
    # the noise is in each, and in the cubic ones nothing else
    assert max(cubic) < 1.2 * NOISE < 1.5 * NOISE < min(linear)


def test_segments_are_fitted_to_or_held_out(noisy, found):
    assert len(found.held_out) == 3
    pieces = sorted([*found.fitted, *found.held_out], key=lambda part: part.time[0])
    assert [p.time[0] for p in pieces] == [noisy.time[0], *(p.time[-1] for p in pieces[:-1])]
    assert pieces[-1].time[-1] == noisy.time[-1]
    # the range is known from what is fitted to
    assert np.concatenate([p.x for p in found.fitted]).min() == found.drift.box.states.lower
    assert np.concatenate([p.x for p in found.fitted]).max() == found.drift.box.states.upper


def test_held_out_segments_change_nothing(noisy, found):
    """An estimate that had seen them would move with them; all else is bit-identical."""
    start, end = found.held_out[0].time[[5, -5]]
    inside = ((noisy.time > start) & (noisy.time < end))[:, None]
    centre = noisy.x[inside[:, 0]].mean()
    spoilt = replace(noisy, x=np.where(inside, centre + 0.1 * (noisy.x - centre), noisy.x))
    again = identify(CUBIC.plant, [spoilt], degrees=(1, 3, 4), methods=methods(10, 20))
    for a, b in ((again.drift, found.drift), (again.linear, found.linear)):
        assert a.coefficients.tobytes() == b.coefficients.tobytes()
        assert a.B.tobytes() == b.B.tobytes()
    assert [score.cost for score in again.scores] == [score.cost for score in found.scores]


def test_known_input_matrix_is_kept_and_the_split_follows_the_seed(noisy, found):
    known = identify(replace(CUBIC.plant, B=CUBIC.B), [noisy], degrees=(1, 2), methods=methods(20),
                     seed=2)
    assert known.drift.input_matrix == pytest.approx(CUBIC.B, rel=1e-12)
    assert known.linear.input_matrix == pytest.approx(CUBIC.B, rel=1e-12)
    assert [p.time[0] for p in known.held_out] != [p.time[0] for p in found.held_out]


def test_two_states_two_inputs_and_records_of_different_length():
    records = [PAIR.excited(n, 0.1, noise=0.01, seed=i) for i, n in enumerate((260, 120, 25, 9))]
    found = identify(PAIR.plant, records, degrees=(1, 2), methods=methods(10, 20))
    assert found.drift.degree == 2
    assert PAIR.misfit(found.drift) < 0.03
    assert found.drift.input_matrix == pytest.approx(PAIR.B, abs=0.03)
    assert found.noise == pytest.approx([0.01, 0.01], rel=0.2)
    # the shortest one is no segment to learn from
    assert min(len(part) for part in (*found.fitted, *found.held_out)) >= 10


METHOD = """
from dataclasses import dataclass
from koopman_ros.learning.identification import DriftEstimate, IdentificationMethod, weak_form


@dataclass(frozen=True)
class OneWindow:
    window: int = 30

    def __post_init__(self):
        if self.window < 5:
            raise ValueError('window must be at least 5')


class Own(IdentificationMethod):
    Parameters = OneWindow

    def estimate(self, problem):
        return [DriftEstimate(weak_form(problem.episodes, problem.box, problem.degree, problem.B,
                                        self.parameters.window), f'{self.parameters.window}')]


class Raising(IdentificationMethod):
    def estimate(self, problem):
        return 1 // 0


class Unfinished(IdentificationMethod):
    pass


def function():
    pass
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / 'own_methods.py').write_text(METHOD)


@pytest.mark.usefixtures('own_module')
def test_a_method_of_ones_own_has_its_own_parameters(noisy):
    """One that raises is a reason, and the others go on."""
    own = methods_of(['own_methods:Own', 'own_methods:Raising'], {'Own': {'window': 12}})
    found = identify(CUBIC.plant, [noisy.part(0, 200)], degrees=(1, 3), methods=own)
    assert {score.method for score in found.scores} == {'Own, 12', 'output error from Own, 12'}
    (warning,) = found.warnings
    assert 'Raising' in warning
    assert 'ZeroDivisionError' in warning
    with pytest.raises(ValueError, match=r'no drift fits the episodes: .*Raising.*ZeroDivision'):
        identify(CUBIC.plant, [noisy.part(0, 200)], degrees=(1,),
                 methods={'Raising': own['Raising']})


@pytest.mark.usefixtures('own_module')
@pytest.mark.parametrize(('name', 'parameters', 'words'), [
    ('own_methods:Unfinished', {}, 'lacks estimate'),
    ('own_methods:function', {}, 'not a subclass of'),
    ('own_methods:Own', {'Own': {'window': 3}}, 'window must be at least 5'),
    ('own_methods:Own', {'Own': {'size': 3}}, 'size'),
    ('own_methods:Absent', {}, 'Absent'), ('weak', {}, 'choose one of weak_form, total_variation'),
    ('weak_form', {'weak_form': {'windows': (3,)}}, 'at least 4')])
def test_methods_are_checked_when_configured(name, parameters, words):
    with pytest.raises(ValueError, match=words):
        methods_of([name], parameters)


def test_progress_and_stop(noisy):
    seen = []
    record = noisy.part(0, 160)
    identify(CUBIC.plant, [record], degrees=(1, 3), methods=methods(10),
             watch=lambda *step: bool(seen.append(step)))
    assert list(dict.fromkeys(seen)) == [
        (0, 3, 'drift of degree 1'), (1, 3, 'drift of degree 3'),
        (2, 3, 'drift of degree 3 on all episodes')]
    # a refinement is watched at each of its steps
    assert all(seen.count(step) > 2 for step in seen)

    # at the beginning of any step, and in the midst of one
    for stop in (1, 2, len(seen)):
        again = []
        with pytest.raises(Stopped):
            identify(CUBIC.plant, [record], degrees=(1, 3), methods=methods(10),
                     watch=lambda *step, again=again, stop=stop: (
                         again.append(step) or len(again) == stop))
        assert again == seen[:stop]


@pytest.mark.parametrize('text', ['drift of degree 1', 'drift of degree 3 on all episodes'])
def test_ctrl_c_ends_it_in_the_midst_of_a_refinement(noisy, text):
    seen = []

    def press(*step):
        seen.append(step[-1])
        if seen.count(text) == 3:
            signal.raise_signal(signal.SIGINT)
        return False

    with pytest.raises(KeyboardInterrupt):
        identify(CUBIC.plant, [noisy.part(0, 160)], degrees=(1, 3), methods=methods(10),
                 watch=press)
    assert seen[-1] == text


def changed(record, **values):
    return replace(record, **{
        name: np.full_like(getattr(record, name), value) for name, value in values.items()})


@pytest.mark.parametrize(('records', 'words'), [
    ([CUBIC.excited(159, 0.1)], '159 samples are too few'),
    ([CUBIC.excited(9, 0.1, seed=i) for i in range(30)],
     'the episodes have 0 uninterrupted segments of 10 samples, at least 8 are needed'),
    ([changed(CUBIC.excited(300, 0.1), u=1.0)], 'u1 is constant at 1.0 A: excite the plant'),
    ([changed(CUBIC.excited(300, 0.1), x=310.0)], 'x1 is constant at 310.0 m: excite'),
])
def test_degenerate_records(records, words):
    with pytest.raises(ValueError, match=words):
        identify(CUBIC.plant, records)


@pytest.mark.parametrize(('n_x', 'highest'), [(1, 6), (2, 6), (3, 4), (4, 3), (12, 3), (13, 2)])
def test_degrees_are_as_many_as_an_hour_determines(n_x, highest):
    plant = replace(PAIR.plant, state_names=tuple(map(str, range(n_x))), state_units=('m',) * n_x,
                    nominal_state=np.zeros(n_x))
    run = PAIR.excited(400, 0.1)
    run = replace(run, x=np.random.default_rng(0).standard_normal((400, n_x)))
    with pytest.raises(Stopped):
        identify(plant, [run], watch=lambda _, total, __: total == highest + 1)


def test_extremes_in_every_segment():
    parts = cut([PAIR.excited(160, 0.1)], 20)[:8]
    for i, part in enumerate(parts):
        x, u = np.zeros_like(part.x), np.zeros_like(part.u)
        # eight extremes in eight segments
        (x if i < 4 else u)[0, i % 2] = 1.0 if i % 4 < 2 else -1.0
        parts[i] = replace(part, x=x, u=u)
    with pytest.raises(ValueError, match='all but 0 of 8 segments'):
        identify(PAIR.plant, [*parts, parts[0].part(0, 5)] + [parts[0].part(0, 9)] * 2)


def test_a_degree_whose_simulation_of_the_record_diverges_gives_way_to_a_lower_one():
    """Three tanks in series, their pump stepped as by the trainer, held for up to 240 s."""
    period, edge = 5.0, np.full(3, np.inf)
    steps = Experiment(3600.0, ('pump',), np.array([3.0]), np.array([9.0]), np.ones(1),
                       np.array([6.0]), 30.0, 240.0, LEVELS, -edge, edge, seed=4).steps
    (ends, pumped), time = steps[0], period * np.arange(720)
    u = pumped[np.searchsorted(ends, time, side='right')][:, None]

    def rate(x, u):
        out = np.sqrt(2.0 * 9.81 * x) * 0.1781 / 15.52
        return np.array([3.3e-2 * u / 15.52 - out[0], out[0] - out[1], out[1] - out[2]])

    x, levels = np.full(3, (3.3e-2 * 6.0 / 0.1781) ** 2 / (2.0 * 9.81)), []
    for flow in u[:, 0]:
        levels.append(x)
        for _ in range(5):
            x = runge_kutta_step(lambda x, flow=flow: rate(x, flow), x, period / 5.0)
    noise = 5e-4 * np.random.default_rng([4, 5]).standard_normal((720, 3))
    episode = Episode(time, np.array(levels) + noise, time, u)
    plant = PlantDescription('tanks', LEVELS, ('m',) * 3, ('pump',), ('V',), 's',
                             np.full(3, np.nan), np.full(1, np.nan), None)
    found = identify(plant, [episode], degrees=(1, 3, 4))
    # the one that errs least in the segments
    assert min(found.scores, key=lambda score: score.cost).degree == 4
    assert found.drift.degree < 4
    record = Segments.of([episode], longest_step([episode]))
    assert np.max(np.abs(record.errors(found.drift.rate, record.x[0]))) < 5.0 * np.max(noise)


def test_linear_model_that_diverges_does_not_stand_in_the_way(noisy, monkeypatch):
    module = sys.modules[identify.__module__]
    original = module.prediction_error
    monkeypatch.setattr(module, 'prediction_error', lambda rate, *others: (
        np.full(1, np.inf) if rate.__self__.degree == 1 else original(rate, *others)))
    found = identify(CUBIC.plant, [noisy.part(0, 200)], degrees=(1, 3), methods=methods(10))
    assert (found.linear.degree, found.drift.degree) == (1, 3)
    monkeypatch.setattr(module, 'prediction_error', lambda *_: np.full(1, np.inf))
    with pytest.raises(ValueError, match='no drift fits the episodes: record longer'):
        identify(CUBIC.plant, [noisy.part(0, 200)], degrees=(1, 3), methods=methods(10))
