# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Imitated machines: their kernels take effect, whatever the environment says."""

import platform

import pytest

import machines


def test_what_is_set_outside_is_put_aside(monkeypatch: pytest.MonkeyPatch) -> None:
    outside = {'OPENBLAS_CORETYPE': 'Nehalem', 'OPENBLAS_L2_SIZE': '512', 'OMP_NUM_THREADS': '7',
               'NPY_DISABLE_CPU_FEATURES': 'X86_V3', 'ATEN_CPU_CAPABILITY': 'avx2'}
    for name, value in outside.items():
        monkeypatch.setenv(name, value)
    found = machines.environment({'OPENBLAS_CORETYPE': 'Prescott'})
    assert {name: found[name] for name in outside.keys() & found.keys()} == {
        'OPENBLAS_CORETYPE': 'Prescott'}
    assert 'PATH' in found


@pytest.mark.skipif(platform.machine() != 'x86_64', reason='the oldest kernels are of x86-64')
def test_numpy_and_scipy_take_the_kernels_of_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('OPENBLAS_CORETYPE', 'Nehalem')
    assert machines.architectures({'OPENBLAS_CORETYPE': 'Prescott'}) == {'Katmai'}
    assert not machines.architectures({'OPENBLAS_CORETYPE': 'Prescott'}) & (
        machines.architectures({}))
