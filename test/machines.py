# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The numerical tests under imitated machines: ``python test/machines.py [--quick] [NAME ...]``.

Other processors are imitated by taking instruction sets away from torch and numpy, other rounding
than either has by disturbing the data of all trainings. OpenBLAS chooses its own kernels as ever:
there are processors that need its variables set. ``--quick`` runs two imitations on the tests
that train most; NAMEs choose among them. Exit status 1 when a test failed.
"""

import argparse
import os
from pathlib import Path
import subprocess
import sys
import time

import numpy as np
import torch

ROOT = Path(__file__).parent.parent
# What holds on every machine or not: the numerics, and what is made of them.
NUMERICAL = ('test/plants', 'test/model', 'test/control', 'test/learning',
             'test/studies/test_studies.py', 'test/test_examples.py')
# Trainings, which amplify rounding: half a minute of them.
TRAINING = ('test/studies/test_shipped_models.py', 'test/learning/lift/test_training.py')
QUICK = ('oldest', 'disturbed')


def imitations() -> dict[str, dict[str, str]]:
    """Return what the environment of each imitated machine says besides."""
    one, two = ({f'{library}_NUM_THREADS': count for library in ('OMP', 'MKL', 'OPENBLAS')}
                for count in '12')
    machines = {'oldest': {'ATEN_CPU_CAPABILITY': 'default', **without(), **one}}
    if torch.backends.cpu.get_cpu_capability() in ('AVX2', 'AVX512'):
        # X86_V4 is what numpy calls AVX-512 since its release 2.4
        machines['avx2'] = {
            'ATEN_CPU_CAPABILITY': 'avx2', **without('AVX512', 'X86_V4'), **one}
    machines['two-threads'] = two
    machines['disturbed'] = {'DISTURB_TRAINING': '1e-13', **one}
    return machines


def without(*parts: str) -> dict[str, str]:
    """Return what takes features that numpy finds away from it, all or by parts of their names."""
    found = np.show_config(mode='dicts')['SIMD Extensions'].get('found', [])
    features = [name for name in found if not parts or any(part in name for part in parts)]
    return {'NPY_DISABLE_CPU_FEATURES': ' '.join(features)} if features else {}


def run(name: str, setting: dict[str, str], tests: tuple[str, ...]) -> bool:
    """Run tests on an imitated machine and tell whether they passed."""
    print(f'== {name}: ' + ', '.join(f'{key}={value}' for key, value in setting.items()),
          flush=True)
    workers = max(1, (os.cpu_count() or 1) // int(setting['OMP_NUM_THREADS']))
    return subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-n', str(workers), '--dist', 'loadfile', *tests],
        cwd=ROOT, env={**os.environ, **setting}, check=False).returncode == 0


def main(arguments: list[str] | None = None) -> int:
    """Run what is asked for, and say what passed."""
    machines = imitations()
    parser = argparse.ArgumentParser(description='The numerical tests under imitated machines.')
    parser.add_argument('names', nargs='*', metavar='NAME',
                        help=f'imitations to run, of {", ".join(machines)} (default: all)')
    parser.add_argument('--quick', action='store_true',
                        help=f'only tests that train, on {" and ".join(QUICK)}')
    asked = parser.parse_args(arguments)
    if unknown := [name for name in asked.names if name not in machines]:
        parser.error(f'this processor has no imitation {unknown[0]}, choose from '
                     f'{", ".join(machines)}')
    results = {}
    for name in asked.names or (QUICK if asked.quick else machines):
        begin = time.monotonic()
        passed = run(name, machines[name], TRAINING if asked.quick else NUMERICAL)
        results[name] = f'{"passed" if passed else "FAILED"} in {time.monotonic() - begin:.0f} s'
    for name, result in results.items():
        print(f'{name}: {result}')
    return int(any(result.startswith('FAILED') for result in results.values()))


if __name__ == '__main__':
    sys.exit(main())
