# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The folder of an exported loop: code, examples, test vectors and README."""

import csv
import io
from os import PathLike
from pathlib import Path

from koopman_ros import __version__
from koopman_ros.control import Controller
from koopman_ros.core.arrays import expect
from koopman_ros.export.c_code import c_code, ExportError, filled, signals, template
from koopman_ros.export.cortex_m4 import report
from koopman_ros.export.vectors import columns, vectors, with_laws
from koopman_ros.model.model_file import digest

_SIZES = ('| Cortex-M4F | code and constants | state | stack | instructions of a step, at most |\n'
          '|---|---|---|---|---|')
_SOURCE = ('Memory is without the C library; stack and instructions are those of the first test '
           'vectors, in QEMU.')
_NOT_MEASURED = ('Code size, stack and instructions are not measured: install gcc-arm-none-eabi, '
                 'libnewlib-arm-none-eabi and qemu-system-arm, and export again.')


def export_c(controller: Controller, folder: str | PathLike[str], *, name: str = 'controller',
             sample_period: float | None = None, calls: int = 200, laws: int = 10) -> None:
    """
    Write a control loop as C code into a folder, as the command ``export_c`` does.

    ``NAME.c`` and ``NAME.h`` are the loop, ``test_vectors.c`` and ``timer_loop.c`` examples,
    ``test_vectors.csv`` calls with the answers of the controller.

    >>> export_c(controller, 'tanks', name='tanks', calls=20)
    >>> from pathlib import Path
    >>> Path('tanks', 'tanks.c').exists()
    True

    :param name: prefix of functions, types, macros and include guard, so that several loops fit in
        one program.
    :param sample_period: shortest time between two calls in s; by default the sample interval of
        the model's training record.
    :param calls: number of test vectors.
    :param laws: commands of a law that are measured on an emulated Cortex-M4F.
    :raises ExportError: for a law, an estimator, a model or a name that cannot be exported.
    """
    expect(controller=(controller, Controller))
    model, output = controller.model, Path(folder)
    period = model.sample_interval if sample_period is None else sample_period
    if not period > 0.0:
        raise ExportError(f'sample_period = {period:g} s must be above 0 s')
    code = c_code(controller, period, name)
    table, rows = io.StringIO(), list(vectors(controller, calls, period))
    csv.writer(table, lineterminator='\n').writerows([columns(controller), *(
        [*call.row(controller), *answer] for call, answer in rows)])
    code['test_vectors.csv'] = table.getvalue()
    output.mkdir(parents=True, exist_ok=True)
    for file, text in code.items():
        (output / file).write_text(text)
    sizes = report(output, name, with_laws(controller, rows, laws))
    (output / 'README.md').write_text(filled(template('README.md'), {
        'NAME': name, 'PREFIX': name.upper(), 'TITLE': f'Control loop of {model.provenance.plant}',
        'VERSION': __version__, 'MODEL': model.kind, 'DIGEST': digest(model),
        'ACCEPTANCE': model.provenance.acceptance, 'LEVELS': ', '.join(controller.levels),
        'PERIOD': f'{period:g}',
        'MEASURED': f'{_SIZES}\n{sizes}\n\n{_SOURCE}' if sizes else _NOT_MEASURED,
        'SIGNALS': '\n'.join(
            f'| {role} | {", ".join(f"{signal} [{unit}]" for signal, unit in of)} |'
            for role, of in signals(controller).items() if of)}))
