# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The imitated machines are other machines, and a disturbed training is another training."""

import os
import subprocess
import sys

import numpy as np
import pytest

from koopman_ros.learning import train, training
import machines
from support import disturbance
from support.small_plants import BENT, bent_samples, bits, SMALL

SEEN = """
import warnings
import numpy as np
print(np.show_config(mode='dicts')['SIMD Extensions'].get('found', []))
import torch
print(torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())
"""


@pytest.fixture
def disturbed(monkeypatch):
    """Disturb trainings until the end of the test."""
    monkeypatch.setattr(disturbance, 'SIZE', 1e-13)
    monkeypatch.setattr(training, 'ScaledSamples', training.ScaledSamples)
    disturbance.disturb_training()


def seen(setting):
    """Return what numpy and torch say of a machine."""
    done = subprocess.run([sys.executable, '-c', SEEN], env={**os.environ, **setting}, text=True,
                          capture_output=True, timeout=100, check=False)
    # nothing is taken away that is not there, of which numpy would warn
    assert (done.returncode, done.stderr) == (0, '')
    return done.stdout.splitlines()


def test_the_oldest_machine_has_no_instructions_but_the_baseline():
    assert seen(machines.imitations()['oldest']) == ['[]', 'DEFAULT 1']


def test_all_that_is_to_run_is_there():
    for path in (*machines.NUMERICAL, *machines.TRAINING):
        assert (machines.ROOT / path).exists(), path
    assert set(machines.QUICK) <= set(machines.imitations())


def test_one_machine_that_fails_is_a_failure(monkeypatch, capsys):
    monkeypatch.setattr(machines, 'run', lambda name, *_: name != 'oldest')
    assert machines.main(['--quick']) == 1
    assert [line.split(' in ')[0] for line in capsys.readouterr().out.splitlines()] == [
        'oldest: FAILED', 'disturbed: passed']
    assert machines.main(['disturbed', 'two-threads']) == 0
    with pytest.raises(SystemExit):
        machines.main(['newest'])
    assert 'has no imitation newest, choose from oldest, ' in capsys.readouterr().err


def test_nothing_is_disturbed_unless_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(disturbance, 'SIZE', 0.0)
    values, before = np.ones(3), training.ScaledSamples
    assert disturbance.disturbed(values) is values
    disturbance.disturb_training()
    assert training.ScaledSamples is before


@pytest.mark.usefixtures('disturbed')
def test_a_disturbance_is_small_and_the_same_each_time():
    values = np.linspace(1.0, 2.0, 1000)
    once, again = (disturbance.disturbed(values) for _ in range(2))
    np.testing.assert_array_equal(once, again)
    assert np.std(once / values - 1.0) == pytest.approx(1e-13, rel=0.1)


def test_a_disturbed_training_is_another_one(monkeypatch, request):
    monkeypatch.setattr(disturbance, 'SIZE', 0.0)
    as_given = train(BENT, bent_samples(), SMALL, starts=1).model
    request.getfixturevalue('disturbed')
    one, same = (train(BENT, bent_samples(), SMALL, starts=1).model for _ in range(2))
    assert bits(one) == bits(same) != bits(as_given)
    assert one.provenance.data_digest == as_given.provenance.data_digest
