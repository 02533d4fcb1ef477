# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What the command lines of both acts have in common."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
import sys

from koopman_ros.testing import reserved_output


def read_options(args: list[str] | None, description: str | None, output: str, speed: float
                 ) -> argparse.Namespace:
    """
    Read `output` and `speed` from a command line.

    :param args: the arguments, or None for the process's own.
    :param description: what the command does.
    :param output: default folder for the results.
    :param speed: default simulated seconds per second.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument('--output', type=Path, default=Path(output),
                        help='folder for the results (default: %(default)s)')
    parser.add_argument('--speed', type=float, default=speed,
                        help='simulated seconds per second, 0 for as fast as the machine can '
                        '(default: %(default)s)')
    return parser.parse_args(args)


def run_act(act: Callable[[Path, float], Mapping[str, object]], options: argparse.Namespace,
            errors: tuple[type[Exception], ...], files: str) -> int:
    """
    Run a demo, and say what came of it.

    :param act: takes the folder for the results and the speed, and returns the summary.
    :param options: as :func:`read_options` returns them.
    :param errors: what is told in one line.
    :param files: in words, what it leaves in the folder.
    :return: the exit code.
    """
    try:
        with reserved_output(options.output) as output:
            if output != options.output:
                print(f'another run writes to {options.output}: this one writes to {output}',
                      flush=True)
            result = act(output, options.speed)
    except errors as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('demo: interrupted; what was recorded is kept', file=sys.stderr)
        return 130
    for key, value in result.items():
        print(f'{key}: {value:.6g}' if isinstance(value, float) else f'{key}: {value}')
    print(f'wrote {output}/{files}')
    return 0
