# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Export a control loop as C code, for targets without Python.

Writes controller.c, controller.h, example.c, test_vectors.csv and README.md.
"""

import argparse
import csv
import io
from pathlib import Path
import sys

from koopman_ros import __version__
from koopman_ros.control import Controller
from koopman_ros.export.c_code import c_code, ExportError, filled, signals, template
from koopman_ros.export.cortex_m4 import measured
from koopman_ros.export.vectors import columns, vectors, with_laws
from koopman_ros.parameters.controller import built, OF_THE_MODEL, table_of
from koopman_ros.parameters.model_checks import load_suitable, LoadedModel
from koopman_ros.parameters.signal_topics import file_parameters

_VECTORS = 200
_MEASURED = 10  # commands of a law, on an emulated Cortex-M4F
_NOT_MEASURED = ('Code size, stack and instructions are not measured: install gcc-arm-none-eabi, '
                 'libnewlib-arm-none-eabi and qemu-system-arm, and export again.')


def main(arguments: list[str] | None = None) -> int:
    """Export, and return the exit code."""
    parser = argparse.ArgumentParser(
        'export_c', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add('--version', action='version', version=__version__)
    add('model', help='name of a bundled model, or path of a .safetensors file')
    add('--law', default='sdre', choices=('sdre', 'linear'), help='highest control law; those '
        'above it in fallback_order are left out (default: sdre)')
    add('--parameters', type=Path, metavar='FILE', help='parameter file of the controller node '
        '(default: its defaults for the model)')
    add('--sample_period', type=float, required=True, metavar='S',
        help='shortest time between two calls, in s')
    add('--output', type=Path, default=Path('controller'), metavar='FOLDER',
        help='output folder (default: controller)')
    options = parser.parse_args(arguments)
    try:
        if not options.sample_period > 0.0:
            raise ExportError(f'sample_period = {options.sample_period:g} s must be above 0 s')
        loaded, controller = loop(options.model, options.law, options.parameters)
        write(loaded, controller, options.sample_period, options.output)
    except (OSError, ValueError) as error:
        print(f'export_c: {" ".join(str(error).split())}', file=sys.stderr)
        return 1
    print(f'{options.output}: {", ".join(sorted(path.name for path in options.output.iterdir()))}')
    return 0


def loop(model: str, law: str, parameters: Path | None = None
         ) -> tuple[LoadedModel, Controller]:
    """
    Return a model and its controller as the controller node would build it.

    :raises ValueError: for a model or parameters that the node rejects.
    """
    given = {'system': ''} if parameters is None else file_parameters(parameters, 'controller')
    loaded = load_suitable(model, force=bool(given.get('load_rejected_model', False)))
    table = table_of(loaded.model, given)
    given = {name: value for name, value in given.items() if name not in OF_THE_MODEL}
    if unknown := sorted(set(given) - set(table.rows)):
        raise ExportError(f'{parameters}: {unknown[0]} is not a parameter of this loop: correct '
                          'or remove it')
    # a file may say 1 for 1.0
    values = {name: float(value) if isinstance(table.rows[name].default, float) else value
              for name, value in given.items()}
    order = table.snapshot(values).tuning.fallback_order
    if law not in order:
        raise ExportError(f'fallback_order = {list(order)} does not contain {law}: add it, or '
                          f'choose another --law')
    settings = table.snapshot({**values, 'fallback_order': order[order.index(law):]})
    if reason := table.check(settings):
        raise ExportError(reason)
    return loaded, built(settings, loaded.model)


def write(loaded: LoadedModel, controller: Controller, sample_period: float, output: Path) -> None:
    """Write the files of a loop into a folder."""
    code = c_code(controller, sample_period)
    table, origin = io.StringIO(), loaded.model.provenance
    rows = list(vectors(controller, _VECTORS, sample_period))
    csv.writer(table, lineterminator='\n').writerows([columns(controller), *(
        [*call.row(controller), *answer] for call, answer in rows)])
    facts = {
        'TITLE': f'Control loop of {origin.plant}', 'VERSION': __version__, 'MODEL': loaded.name,
        'DIGEST': loaded.digest, 'ACCEPTANCE': origin.acceptance,
        'LEVELS': ', '.join(controller.levels), 'PERIOD': f'{sample_period:g}',
        'SIGNALS': '\n'.join(f'| {role} | {", ".join(f"{name} [{unit}]" for name, unit in of)} |'
                             for role, of in signals(controller).items())}
    code['test_vectors.csv'] = table.getvalue()
    output.mkdir(parents=True, exist_ok=True)
    for name, text in code.items():
        (output / name).write_text(text)
    found = measured(output, with_laws(controller, rows, _MEASURED))
    facts['MEASURED'] = str(found or _NOT_MEASURED)
    (output / 'README.md').write_text(filled(template('README.md'), facts))
