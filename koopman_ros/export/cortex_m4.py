# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Memory and instructions of exported code on an ARM Cortex-M4F, emulated by QEMU."""

from collections.abc import Sequence
from pathlib import Path
import subprocess
import tempfile
from typing import NamedTuple

from koopman_ros.export.c_code import prefixed, template

_FLAGS = ('-std=c99', '-mcpu=cortex-m4', '-mthumb', '-mfpu=fpv4-sp-d16', '-mfloat-abi=hard')
_MACHINE = ('-M', 'mps2-an386', '-cpu', 'cortex-m4', '-nographic', '-monitor', 'none', '-serial',
            'none', '-icount', 'shift=0', '-semihosting-config', 'enable=on,target=native')


#: of the compiler, for which sizes are given
OPTIMISATIONS = ('-O2', '-Os')


class CortexM4(NamedTuple):
    """Memory and instructions of the code, and its answers to some calls."""

    code: int  #: bytes of code and constants, without the C library
    state: int  #: bytes of a ``controller_state``
    stack: int  #: bytes, at most
    instructions: int  #: of a step, at most
    answers: list[str]  #: rows, as those of the example


def measured(folder: Path, name: str, calls: Sequence[str], optimisation: str = '-O2'
             ) -> CortexM4 | None:
    """
    Compile an exported folder and run its test of vectors; None without compiler or QEMU.

    :param name: of the loop.
    :param calls: rows of ``test_vectors.csv``.
    """
    try:
        with tempfile.TemporaryDirectory() as place:
            program, code, wrapper = (
                f'{place}/{file}' for file in ('program.elf', f'{name}.o', 'cortex_m4.c'))
            Path(wrapper).write_text(prefixed(template('cortex_m4.c'), name))
            compiler = ('arm-none-eabi-gcc', *_FLAGS, optimisation, f'-I{folder}')
            _run(*compiler, '-c', folder / f'{name}.c', '-o', code)
            _run(*compiler, code, folder / 'test_vectors.c', wrapper, '--specs=rdimon.specs',
                 '-Wl,--section-start=.vectors=0', f'-Wl,--wrap={name}_step', '-lm', '-o', program)
            text, data = _run('arm-none-eabi-size', code).stdout.splitlines()[1].split()[:2]
            ran = _run('qemu-system-arm', *_MACHINE, '-kernel', program, calls='\n'.join(calls))
    except (OSError, subprocess.CalledProcessError):
        return None
    instructions, stack, state = map(int, ran.stderr.splitlines()[-1].split())
    return CortexM4(int(text) + int(data), state, stack, instructions, ran.stdout.splitlines())


def report(folder: Path, name: str, calls: Sequence[str]) -> str:
    """Return the rows of a table of memory and instructions; none without compiler or QEMU."""
    found = {flag: measured(folder, name, calls, flag) for flag in OPTIMISATIONS}
    return '\n'.join(
        f'| `{flag}` | {one.code / 1e3:.1f} kB | {one.state / 1e3:.2f} kB | {one.stack / 1e3:.1f} '
        f'kB | {one.instructions / 1e6:.2f} million |'
        for flag, one in found.items() if one is not None)


def _run(*command: object, calls: str = '') -> subprocess.CompletedProcess[str]:
    return subprocess.run(list(map(str, command)), input=calls, check=True, capture_output=True,
                          text=True)
