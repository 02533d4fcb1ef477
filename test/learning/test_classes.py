# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Classes of models learned from one record: the choice, by rule or by name; its report."""

from dataclasses import replace
import json

import numpy as np
import pytest

from koopman_ros.execution.training import class_lines, scalars
from koopman_ros.learning import (
    compare_classes,
    drift_sampling,
    evaluate_model,
    IncrementalTraining,
    NeuralDrift,
    retrain,
    Thresholds,
    TrainingTask,
)
from koopman_ros.learning.identification import identify, Stopped
from koopman_ros.model_classes import BEST, CLASSES
from koopman_ros.records import read
from support.known_plants import KnownPlant, methods
from support.quick_retraining import page_of, quick_retraining
from support.recorded_runs import INPUTS, linear_run, STATES, write_bag

NOISE = 0.01  # m
# dx/dt = -x - 0.3 x^2 + 2 u
BENT = KnownPlant(((1, 0), (2, 0)), (-1.0, -0.3), np.array([[2.0]]))
GATE = Thresholds()


@pytest.fixture(scope='module', autouse=True)
def small_networks():
    """Learn small networks; that of the identity lift is the task's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drift_sampling, 'usual_recipes', lambda _: {
            'neural drift': NeuralDrift(3, max_iterations=60),
            'identity lift': IncrementalTraining(2),
            'free lift': IncrementalTraining(1, identity=False, hidden_first=3,
                                             max_iterations=60)})
        yield


def minute_of_steps(plant, noise):
    """Return ten samples a second."""
    rng = np.random.default_rng(0)
    steps = np.arange(0.0, 60.0, 0.8)
    return plant.record(0.1 * np.arange(600), steps, rng.uniform(-0.5, 0.7, (len(steps), 1)),
                        noise=noise)


def identified(plant, noise):
    return identify(plant.plant, [minute_of_steps(plant, noise)], degrees=(1, 2),
                    methods=methods(20))


def compared(found, model_class=BEST, thresholds=GATE, n_z=2, **others):
    return compare_classes(found, BENT.plant, thresholds, model_class=model_class, n_z=n_z, seed=0,
                           starts=1, loops=4, **others)


@pytest.fixture(scope='module')
def found():
    return identified(BENT, NOISE)


@pytest.fixture(scope='module')
def course():
    """Return the progress that a comparison reports: its starts, and its closed loops."""
    return [], []


@pytest.fixture(scope='module')
def best(found, course):
    """Compare the classes on the record of the bent plant, whose drift is of degree 2."""
    learning, judging = course
    return compared(found, watch=lambda now: bool(learning.append(now)),
                    judging=lambda *now: bool(judging.append(now)))


def test_the_class_of_the_truth_is_chosen(found, best):
    assert [one.name for one in best.contenders] == list(CLASSES)
    linear, polynomial, *_ = best.contenders
    assert best.chosen is polynomial
    assert polynomial.model.n_z == 2
    # the truth, as far as a minute with this noise tells
    x, u = np.linspace(-0.8, 0.9, 20)[:, None], np.zeros((20, 1))
    model = best.model
    rate = model.states.scale * (model.drift(model.states.to_deviation(x))
                                 + model.inputs.to_deviation(u) @ model.B.T)
    assert np.max(np.abs(rate - BENT.rate(x, u))) < 0.02
    assert linear.excess > 10.0 * polynomial.excess


@pytest.mark.parametrize(('bend', 'chosen'), [(-0.03, 'linear'), (-0.06, 'polynomial')])
def test_noise_neither_hides_an_error_nor_makes_one(bend, chosen):
    """Linear predictions are 9 and 33 % off, by mean squares less than twice the others'."""
    found = identified(replace(BENT, coefficients=(-1.0, bend)), NOISE)
    assert found.drift.degree == 2
    comparison = compared(found, thresholds=Thresholds(margin=0.0), n_z=1)
    linear, polynomial = (float(one.figures.rollout_rmse[0]) for one in comparison.contenders[:2])
    assert 1.05 < linear / polynomial < np.sqrt(2.0)
    assert comparison.chosen.name == chosen
    # which no linear model has to be better than
    assert evaluate_model(found, comparison, None, GATE, loops=4).accepted


@pytest.fixture
def monomials_judged(monkeypatch):
    """Judge the condition number of a polynomial, too, so that a simple class is rejected."""
    monkeypatch.setattr('koopman_ros.learning.acceptance.held_out.PolynomialObservables', ())


@pytest.mark.usefixtures('monomials_judged')
def test_a_class_that_the_gate_would_reject_is_not_chosen(found, best):
    # between the coordinates of the neural drift, which are the states, and those of the others
    strict = Thresholds(condition=0.5 * (1.0 + best.contenders[1].figures.fit.cond))
    again = compared(found, thresholds=strict, n_z=1)
    assert again.chosen.name == 'neural drift'
    assert again.contenders[1].rejection.startswith('the condition number of its coordinates')
    # nor is one that cannot be learned: identity coordinates beyond the state are none here
    assert again.contenders[3].model is None
    assert again.contenders[3].rejection.startswith('n_z = 1 is too small for 1 states')
    with pytest.raises(ValueError, match='n_z = 1 is too small for 1 states'):
        compared(found, 'identity lift', n_z=1)


@pytest.mark.parametrize('name', ['linear', 'free lift'])
def test_a_class_that_is_named_is_learned_alone(found, name):
    alone = compared(found, name)
    assert [one.name for one in alone.contenders] == [name]
    assert alone.chosen.name == name
    decision = evaluate_model(found, alone, None, GATE, loops=4)
    # its loops are not run again
    assert decision.law_check is alone.chosen.law_check
    assert decision.rmse == alone.figures.rollout_rmse
    assert decision.accepted


@pytest.mark.usefixtures('monomials_judged')
def test_a_rejection_advises_to_compare_the_classes_unless_they_were_compared(found, best):
    strict = Thresholds(condition=0.5 * (1.0 + best.figures.fit.cond))
    for learned, advised in ((best, False), (compared(found, 'polynomial'), True)):
        (reason,) = evaluate_model(found, learned, None, strict, loops=4).reasons
        assert reason.startswith('the condition number')
        assert (f'set model_class to {BEST}' in reason) == advised


def test_progress_counts_the_starts_of_all_classes(course, best):
    learning, judging = course
    assert list(dict.fromkeys(now.name for now in learning)) == list(CLASSES[2:])
    shares = [now.finished for now in learning]
    assert shares == sorted(shares)
    assert shares[-1] == learning[-1].total == 3
    assert list(dict.fromkeys(name for name, _ in judging)) == list(CLASSES)


def test_comparison_that_is_stopped(found):
    with pytest.raises(Stopped):
        compared(found, judging=lambda name, share: name == 'polynomial' and share > 0.5)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('bag') / 'linear.mcap', linear_run(200))


def task(bag, folder, model_class):
    return TrainingTask((str(bag),), str(folder / 'new.safetensors'), '', STATES, INPUTS,
                        coordinates=2, starts=1, model_class=model_class,
                        dead_time={'coolant_temperature': 0.0})


@pytest.fixture
def quick():
    with quick_retraining(4, (1,), (10,)):
        yield


def test_classes_side_by_side_in_report_and_summary(tmp_path):
    """A plant that is bent, and a limit that only models with one coordinate keep."""
    told, run = [], minute_of_steps(BENT, NOISE)
    record = read({'time [s]': run.time, STATES[0].name: 300.0 + run.x[:, 0],
                   INPUTS[0].name: 300.0 + run.inputs_at(run.time)[:, 0]},
                  f'{STATES[0].name} [K]', f'{INPUTS[0].name} [K]')
    with quick_retraining(4, (1, 2)):
        retrained = retrain(replace(task('', tmp_path, BEST), condition=1.1),
                            lambda *now: bool(told.append(now)), record=record)
    assert retrained.reasons == ()
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert 'judging: linear' in [text for _, text in told]
    figures = json.loads(json.dumps(retrained.summary(), allow_nan=False))
    chosen = figures['model_class']
    assert [name for name, one in figures['classes'].items() if one['chosen']] == [chosen]
    lift, best = (figures['classes'][name] for name in ('identity lift', chosen))
    assert 'condition number' in lift['rejection']
    assert best['heldout_error'] == figures['heldout_error']
    rows = [line for line in page_of(retrained).splitlines()
            if line.split(' | ')[0][2:] in CLASSES]
    assert [row.endswith('| chosen |') for row in rows] == [name == chosen for name in CLASSES]
    lines = class_lines(figures)
    assert list(lines) == list(CLASSES)
    assert lines[chosen].startswith('chosen: ')
    assert '; rejected: ' in lines['identity lift']
    assert scalars(figures)[f'class {chosen}'] == lines[chosen]


@pytest.mark.usefixtures('quick')
def test_of_a_linear_drift_the_linear_model_alone_is_learned(bag, tmp_path):
    retrained = retrain(task(bag, tmp_path, BEST))
    assert retrained.accepted
    assert list(retrained.summary()['classes']) == ['linear']


@pytest.mark.usefixtures('quick')
def test_a_report_of_one_class_has_no_comparison(bag, tmp_path):
    retrained = retrain(task(bag, tmp_path, 'polynomial'))
    assert class_lines(retrained.summary()) == {}
    # exact, but no better than the linear model
    assert 'best linear model' in retrained.reasons[0]


@pytest.mark.usefixtures('quick')
def test_a_task_that_cannot_be_run_writes_nothing(bag, tmp_path):
    for change, text in (({'executor': 'joblib:0'}, "executor is 'joblib:0', must be"),
                         ({'device': 'abacus'}, "device is 'abacus', but torch"),
                         ({'model_class': 'lift'}, "model_class = 'lift' must be one of linear")):
        with pytest.raises(ValueError, match=text):
            retrain(replace(task(bag, tmp_path, 'linear'), **change))
    assert list(tmp_path.glob('*.safetensors')) == []
