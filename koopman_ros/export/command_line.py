# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
Export a control loop as C code, for targets without Python.

Writes NAME.c, NAME.h, two examples, test_vectors.csv and README.md.
"""

import argparse
from pathlib import Path
import sys

from koopman_ros import __version__
from koopman_ros.control import Controller
from koopman_ros.export.c_code import ExportError
from koopman_ros.export.folder import export_c
from koopman_ros.parameters.controller import built, OF_THE_MODEL, table_of
from koopman_ros.parameters.model_checks import load_suitable
from koopman_ros.parameters.signal_topics import file_parameters


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
    add('--name', default='controller', help='prefix of functions, types, macros and files, e.g. '
        'tank_1, if several loops are part of one program (default: controller)')
    add('--sample_period', type=float, metavar='S', help='shortest time between two calls, in s '
        '(default: that of the samples of the training record)')
    add('--output', type=Path, metavar='FOLDER', help='output folder (default: the name)')
    options = parser.parse_args(arguments)
    output = options.output or Path(options.name)
    try:
        export_c(loop(options.model, options.law, options.parameters), output, name=options.name,
                 sample_period=options.sample_period)
    except (OSError, ValueError) as error:
        print(f'export_c: {" ".join(str(error).split())}', file=sys.stderr)
        return 1
    print(f'{output}: {", ".join(sorted(path.name for path in output.iterdir()))}')
    return 0


def loop(model: str, law: str, parameters: Path | None = None) -> Controller:
    """
    Return the controller of a model as the controller node would build it.

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
    return built(settings, loaded.model)
