# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The numerical tests under imitated machines: ``python test/machines.py [--quick] [NAME ...]``.

A machine is the OpenBLAS kernels of a processor, the instruction sets of NumPy and torch that go
with them, and a number of threads. All kernels are taken that this processor can run. One more
machine disturbs the data of all trainings, and so rounds as no processor does. ``--quick`` runs
tests that depend most on rounding, on two kernels other than this processor's own; NAMEs choose
among the machines. Variables of these libraries that are set outside do not count. Exit status 1
when a test failed.
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
NUMERICAL = ('test/core', 'test/plants', 'test/model', 'test/estimation', 'test/control',
             'test/evaluation', 'test/learning', 'test/export', 'test/studies/test_studies.py',
             'test/test_examples.py')
# Decisions of the controller, and trainings, which amplify rounding.
QUICK = ('test/control', 'test/studies/test_shipped_models.py',
         'test/learning/lift/test_training.py')
# Kernels of x86-64 from the oldest on: OPENBLAS_CORETYPE, what OpenBLAS calls them then, and parts
# of the names of the features of NumPy that their processors lack; all for ().
KERNELS = (('Prescott', 'Katmai', ()), ('Nehalem', 'Nehalem', ()),
           ('Sandybridge', 'Sandybridge', ()),
           # NumPy calls AVX-512 X86_V4 since its release 2.4
           ('Haswell', 'Haswell', ('AVX512', 'X86_V4')), ('Zen', 'Zen', ('AVX512', 'X86_V4')),
           ('SkylakeX', 'SkylakeX', None))
LIBRARIES = ('OPENBLAS_', 'OMP_', 'MKL_', 'NPY_', 'ATEN_', 'NVPL_', 'GOTO_', 'BLIS_')
# What a processor that lacks an instruction of the kernels does not survive.
PROBE = """
import numpy as np, scipy.linalg, threadpoolctl
A = np.random.default_rng(0).standard_normal((70, 70))
for library in (np.linalg, scipy.linalg):
    library.solve(A, A @ A), library.svd(A), library.eigvals(A), library.qr(A)
scipy.linalg.schur(A), scipy.linalg.blas.dgemm(1.0, A, A)
print(*(found['architecture'] for found in threadpoolctl.threadpool_info()
        if found['internal_api'] == 'openblas'))
"""


def environment(setting: dict[str, str]) -> dict[str, str]:
    """Return the environment of a machine: what is set outside for its libraries is put aside."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(LIBRARIES)}
    return {**kept, **setting}


def architectures(setting: dict[str, str]) -> set[str]:
    """Return which kernels the OpenBLAS of NumPy and that of SciPy take; none if they crash."""
    found = subprocess.run([sys.executable, '-c', PROBE], env=environment(setting), check=False,
                           stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    return set(found.stdout.split()) if found.returncode == 0 else set()


def kernels() -> dict[str, dict[str, str]]:
    """Return the settings of each kernel that this processor can run, the oldest first."""
    runnable = {}
    for coretype, architecture, lacking in KERNELS:
        setting = {'OPENBLAS_CORETYPE': coretype}
        if architectures(setting) != {architecture}:
            # the processor lacks instructions, or this OpenBLAS the kernels, and takes others
            print(f'not here: {coretype}')
            continue
        if lacking == ():
            setting |= {'ATEN_CPU_CAPABILITY': 'default', **without()}
        elif lacking is not None:
            setting |= without(*lacking)
            if torch.backends.cpu.get_cpu_capability() == 'AVX512':
                setting['ATEN_CPU_CAPABILITY'] = 'avx2'
        runnable[architecture] = setting
    return runnable


def without(*parts: str) -> dict[str, str]:
    """Return what takes features that numpy finds away from it, all or by parts of their names."""
    found = np.show_config(mode='dicts')['SIMD Extensions'].get('found', [])
    features = [name for name in found if not parts or any(part in name for part in parts)]
    return {'NPY_DISABLE_CPU_FEATURES': ' '.join(features)} if features else {}


def threads(count: int) -> dict[str, str]:
    """Return what sets the number of threads of all libraries."""
    return {f'{library}_NUM_THREADS': str(count) for library in ('OMP', 'MKL', 'OPENBLAS')}


def imitations() -> tuple[dict[str, dict[str, str]], tuple[str, ...]]:
    """Return the settings of each imitated machine, and the names of those of a quick run."""
    found = kernels()
    # another processor than x86-64, or another library: its own kernels
    named = {setting['OPENBLAS_CORETYPE'].lower(): setting for setting in found.values()} or {
        'own': {}}
    machines = {name: {**setting, **threads(1)} for name, setting in named.items()}
    machines |= {f'{name}-two-threads': {**setting, **threads(2)}
                 for name, setting in named.items()}
    machines['disturbed'] = {'DISTURB_TRAINING': '1e-13', **threads(1)}
    own = architectures({})
    others = [setting['OPENBLAS_CORETYPE'].lower() for architecture, setting in found.items()
              if architecture not in own]
    return machines, tuple(dict.fromkeys((*others[:1], *others[-1:]))) or ('disturbed',)


def run(name: str, setting: dict[str, str], tests: tuple[str, ...]) -> bool:
    """Run tests on an imitated machine and tell whether they passed."""
    print(f'== {name}: ' + ', '.join(f'{key}={value}' for key, value in setting.items()),
          flush=True)
    workers = max(1, (os.cpu_count() or 1) // int(setting['OMP_NUM_THREADS']))
    return subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-n', str(workers), '--dist', 'loadfile', *tests],
        cwd=ROOT, env=environment(setting), check=False).returncode == 0


def main(arguments: list[str] | None = None) -> int:
    """Run what is asked for, and say what passed."""
    machines, quick = imitations()
    parser = argparse.ArgumentParser(description='The numerical tests under imitated machines.')
    parser.add_argument('names', nargs='*', metavar='NAME',
                        help=f'machines to run, of {", ".join(machines)} (default: all)')
    parser.add_argument('--quick', action='store_true',
                        help='only the tests that depend most on rounding, on '
                             f'{" and ".join(quick)}')
    asked = parser.parse_args(arguments)
    if unknown := [name for name in asked.names if name not in machines]:
        parser.error(f'this processor has no machine {unknown[0]}, choose from '
                     f'{", ".join(machines)}')
    results = {}
    for name in asked.names or (quick if asked.quick else machines):
        begin = time.monotonic()
        passed = run(name, machines[name], QUICK if asked.quick else NUMERICAL)
        results[name] = f'{"passed" if passed else "FAILED"} in {time.monotonic() - begin:.0f} s'
    for name, result in results.items():
        print(f'{name}: {result}')
    return int(any(result.startswith('FAILED') for result in results.values()))


if __name__ == '__main__':
    sys.exit(main())
