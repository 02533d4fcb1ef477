# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Memory and instructions of exported code on an ARM Cortex-M4F, emulated by QEMU."""

from collections.abc import Sequence
from importlib.resources import as_file, files
from pathlib import Path
import subprocess
import tempfile
from typing import NamedTuple

_FLAGS = ('-std=c99', '-O2', '-fno-inline', '-mcpu=cortex-m4', '-mthumb', '-mfpu=fpv4-sp-d16',
          '-mfloat-abi=hard')
_MACHINE = ('-M', 'mps2-an386', '-cpu', 'cortex-m4', '-nographic', '-monitor', 'none', '-serial',
            'none', '-icount', 'shift=0', '-semihosting-config', 'enable=on,target=native')


class CortexM4(NamedTuple):
    """Memory and instructions of the code, and its answers to some calls."""

    code: int  #: bytes of code and constants, without the C library
    state: int  #: bytes of a ``koopman_state``
    stack: int  #: bytes, at most
    instructions: int  #: of a step, at most
    answers: list[str]  #: rows, as those of the example

    def __str__(self) -> str:
        return (f'On a Cortex-M4F, with {" ".join(_FLAGS[1:3])}: {self.code / 1e3:.0f} kB of code '
                f'and constants without the C library, {self.state / 1e3:.1f} kB of state, '
                f'{self.stack / 1e3:.1f} kB of stack and up to {self.instructions / 1e6:.1f} '
                'million instructions per step (QEMU, first test vectors).')


def measured(folder: Path, calls: Sequence[str]) -> CortexM4 | None:
    """
    Compile an exported folder and run its example; None without a cross compiler or QEMU.

    :param calls: rows of ``test_vectors.csv``.
    """
    startup = as_file(files(__package__) / 'templates' / 'cortex_m4.c')
    try:
        with tempfile.TemporaryDirectory() as place, startup as wrapper:
            program, code = f'{place}/program.elf', f'{place}/controller.o'
            compiler = ('arm-none-eabi-gcc', *_FLAGS, f'-I{folder}')
            _run(*compiler, '-c', folder / 'controller.c', '-o', code)
            _run(*compiler, code, folder / 'example.c', wrapper, '--specs=rdimon.specs',
                 '-Wl,--section-start=.vectors=0', '-Wl,--wrap=koopman_step', '-lm', '-o', program)
            text, data = _run('arm-none-eabi-size', code).stdout.splitlines()[1].split()[:2]
            ran = _run('qemu-system-arm', *_MACHINE, '-kernel', program, calls='\n'.join(calls))
    except (OSError, subprocess.CalledProcessError):
        return None
    instructions, stack, state = map(int, ran.stderr.splitlines()[-1].split())
    return CortexM4(int(text) + int(data), state, stack, instructions, ran.stdout.splitlines())


def _run(*command: object, calls: str = '') -> subprocess.CompletedProcess[str]:
    return subprocess.run(list(map(str, command)), input=calls, check=True, capture_output=True,
                          text=True)
