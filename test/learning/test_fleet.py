# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Retraining of many plants in one call, some of them from a sibling's lift."""


import pytest

from koopman_ros.learning import retrain, retrain_fleet, TrainingTask
from koopman_ros.model import load
from support.quick_retraining import quick_retraining
from support.recorded_runs import driven, INPUTS, reactor, STATES, write_bag


@pytest.fixture(scope='module', name='tasks')
def tasks_of_reactors(tmp_path_factory):
    """Two reactors, and one whose bag is missing, first of the fleet."""
    folder = tmp_path_factory.mktemp('bags')
    bags = {'lost': folder / 'none.mcap', **{
        name: write_bag(folder / f'{name}.mcap', driven(reactor(share), 12.0))
        for name, share in (('first', 1.0), ('second', 0.9))}}
    return {name: TrainingTask((str(bag),), str(folder / f'{name}.safetensors'), '', STATES,
                               INPUTS, coordinates=2, starts=1, warm_start_model='first',
                               model_class='identity lift')
            for name, bag in bags.items()}


@pytest.fixture(scope='module', autouse=True)
def few_methods():
    """Estimate by a few methods alone, and try laws in a few loops."""
    with quick_retraining(4):
        yield


@pytest.fixture(scope='module', name='ended')
def ended_fleet(tasks, few_methods):
    """Return what was told, and the outcomes in their order."""
    told = []
    return told, list(retrain_fleet(tasks, on_progress=lambda *now: told.append(now)))


def test_each_plant_has_its_own_outcome(tasks, ended):
    told, outcomes = ended
    found = dict(outcomes)
    # the one that fails is tried first, and the next of its kind then leads
    assert [name for name, _ in outcomes] == ['lost', 'first', 'second']
    assert 'does not exist' in found['lost'].error
    assert not found['lost'].accepted
    for name in ('first', 'second'):
        assert found[name].accepted, found[name].summary['reasons']
        assert load(tasks[name].output).n_z == 2
        assert tasks[name].output.replace('.safetensors', '.json') in found[name].files
    assert {name for name, *_ in told} >= {'first', 'second'}
    assert all(0.0 <= share <= 1.0 for _, share, _ in told)


def test_a_lift_begins_from_that_of_the_first_sibling(tasks, ended):
    by_name = dict(ended[1])
    steps = {name: by_name[name].summary['classes']['identity lift']['steps']
             for name in ('first', 'second')}
    assert 0 < steps['second'] < steps['first']


def test_invalid_arguments_are_rejected_before_the_start(tasks):
    twice = {'a': tasks['first'], 'b': tasks['first']}
    with pytest.raises(ValueError, match='a and b would both write'):
        next(retrain_fleet(twice))
    with pytest.raises(ValueError, match='no plant to retrain'):
        next(retrain_fleet({}))
    with pytest.raises(ValueError, match="warm_start_model = 'first' means the first model of a"):
        retrain(tasks['first'])
