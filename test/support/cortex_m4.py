# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The exported code on an ARM Cortex-M4F: size, stack and instructions, under QEMU."""

from dataclasses import dataclass
from pathlib import Path
import subprocess
import tempfile

COMPILER, EMULATOR = 'arm-none-eabi-gcc', 'qemu-system-arm'
_FLAGS = ('-std=c99', '-O2', '-fno-inline', '-mcpu=cortex-m4', '-mthumb', '-mfpu=fpv4-sp-d16',
          '-mfloat-abi=hard')


@dataclass(frozen=True)
class CortexM4:
    """Memory and instructions of the code, and its answers to some calls."""

    code: int  #: bytes of code and constants, without the C library
    state: int  #: bytes of a ``koopman_state``
    stack: int  #: bytes, at most
    instructions: int  #: of a step, at most
    answers: str  #: rows, as those of the example


def run(folder: Path, calls: str, timeout: float = 300.0) -> CortexM4:
    """
    Compile an exported folder, and run its example.

    :param calls: rows of ``test_vectors.csv``.
    :raises subprocess.CalledProcessError: where the code does not compile.
    """
    startup = Path(__file__).with_suffix('.c')
    with tempfile.TemporaryDirectory() as place:
        program, code = Path(place) / 'program.elf', Path(place) / 'controller.o'

        def compiled(*arguments: object) -> None:
            subprocess.run([COMPILER, *_FLAGS, f'-I{folder}', *map(str, arguments)], check=True)

        compiled('-c', folder / 'controller.c', '-o', code)
        size = subprocess.run(['arm-none-eabi-size', code], check=True, capture_output=True,
                              text=True).stdout.splitlines()[1].split()
        compiled(code, folder / 'example.c', startup, '--specs=rdimon.specs',
                 '-Wl,--section-start=.vectors=0', '-Wl,--wrap=koopman_step', '-lm', '-o', program)
        ran = subprocess.run(
            [EMULATOR, '-M', 'mps2-an386', '-cpu', 'cortex-m4', '-nographic', '-monitor', 'none',
             '-serial', 'none', '-icount', 'shift=0', '-semihosting-config',
             'enable=on,target=native', '-kernel', program],
            check=True, input=calls, capture_output=True, text=True, timeout=timeout)
        symbols = subprocess.run(['arm-none-eabi-nm', '-S', program], check=True,
                                 capture_output=True, text=True).stdout.splitlines()
        state = next(line.split()[1] for line in symbols if ' b state' in line)
    most, deepest = ran.stderr.splitlines()[-1].split()
    return CortexM4(int(size[0]) + int(size[1]), int(state, 16), int(deepest), int(most),
                    ran.stdout)
