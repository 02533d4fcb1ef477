# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The imitated machines are other machines, and a disturbed training is another training."""

import os
import subprocess
import sys

from koopman_ros.learning import train
from koopman_ros.learning.lift import scaling
import machines
from support import disturbance
from support.small_plants import BENT, bent_samples, bits, SMALL

SEEN = """
import numpy as np
print(np.show_config(mode='dicts')['SIMD Extensions'].get('found', []))
import torch
print(torch.backends.cpu.get_cpu_capability(), torch.get_num_threads())
"""


def test_the_oldest_machine_has_no_instructions_but_the_baseline():
    environment = {**os.environ, **machines.imitations()['oldest']}
    done = subprocess.run([sys.executable, '-c', SEEN], env=environment, text=True,
                          capture_output=True, timeout=100, check=False)
    # nothing is taken away that is not there, of which numpy would warn
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.splitlines() == ['[]', 'DEFAULT 1']


def test_all_that_is_to_run_is_there_and_one_machine_that_fails_is_a_failure(monkeypatch, capsys):
    for path in (*machines.NUMERICAL, *machines.TRAINING):
        assert (machines.ROOT / path).exists(), path
    monkeypatch.setattr(machines, 'run', lambda name, *_: name != 'oldest')
    assert machines.main(['--quick']) == 1
    assert [line.split(' in ')[0] for line in capsys.readouterr().out.splitlines()] == [
        'oldest: FAILED', 'disturbed: passed']
    assert machines.main(['disturbed', 'two-threads']) == 0


def test_a_disturbed_training_is_another_one(monkeypatch):
    # set so that it is put back
    monkeypatch.setattr(scaling, 'ScaledSamples', scaling.ScaledSamples)
    monkeypatch.setattr(disturbance, 'SIZE', 0.0)
    disturbance.disturb_training()
    as_given = train(BENT, bent_samples(), SMALL, starts=1, loops=16).model
    monkeypatch.setattr(disturbance, 'SIZE', 1e-13)
    disturbance.disturb_training()
    one, same = (train(BENT, bent_samples(), SMALL, starts=1, loops=16).model
                 for _ in range(2))
    assert bits(one) == bits(same) != bits(as_given)
    assert one.provenance.data_digest == as_given.provenance.data_digest
