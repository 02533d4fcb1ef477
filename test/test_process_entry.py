# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""First and last steps of a program: the threads of its linear algebra, and signals."""

import os
import signal
import subprocess
import sys

import pytest

# In place of the main function of a program: the bits of an inverse, which depend on the number of
# threads from some 100 rows on.
LOOK = """
import hashlib, sys, types
from koopman_ros import process_entry

def look():
    import numpy as np
    inverse = np.linalg.inv(np.random.default_rng(0).normal(size=(400, 400)))
    print(hashlib.sha256(inverse.tobytes()).hexdigest())
    return 0

process_entry.importlib = types.SimpleNamespace(
    import_module=lambda name: types.SimpleNamespace(main=look))
process_entry.run_program(f'koopman_ros.nodes.{sys.argv[1]}', 130)
"""
NAMES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


def bits(program: str, threads: str) -> str:
    environment = {name: text for name, text in os.environ.items() if name not in NAMES}
    if threads:
        environment |= dict.fromkeys(NAMES, threads)
    return subprocess.run([sys.executable, '-c', LOOK, program], env=environment, check=True,
                          capture_output=True, text=True, timeout=240).stdout


def test_bits_of_a_program_do_not_depend_on_the_number_of_threads() -> None:
    """As it is by default, or set by the user."""
    one = bits('controller', '1')
    assert len(one) == 65
    assert bits('controller', '') == bits('replay', '4') == one


# A program that does not end by an interrupt, as where a library catches it.
STUBBORN = """
import sys, time, types
from koopman_ros import process_entry

def work():
    print('begun', flush=True)
    while True:
        try:
            time.sleep(600.0)
        except KeyboardInterrupt:
            pass

process_entry.importlib = types.SimpleNamespace(
    import_module=lambda name: types.SimpleNamespace(main=work))
process_entry.run_program('work', 130, 0.01)
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_program_ends_soon_after_a_signal_whatever_it_does(number: int) -> None:
    with subprocess.Popen([sys.executable, '-c', STUBBORN], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == 'begun\n'
        process.send_signal(number)
        _, complaint = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert 'interrupted' in complaint
