# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
How far the loop can be pushed: a report with figures, and ``summary.json``.

Run it as ``python -m validation.robustness`` (needs the `train`, `demo` and
`bench` requirements).
"""

import argparse
from pathlib import Path
import sys
import time

from tqdm import tqdm

from koopman_ros import __version__
from koopman_ros.reports import write_figures
from validation.robustness.figures import draw
from validation.robustness.report import write_report
from validation.robustness.study import study


def main(args: list[str] | None = None) -> int:
    """Run the study and write what it found."""
    parser = argparse.ArgumentParser(
        prog='python -m validation.robustness',
        description='Compute margins, region of attraction, disturbances, noise and the guard '
        'against narrow data.')
    parser.add_argument('--output', type=Path, default=Path('out/studies-robustness'),
                        help='folder for figures and report (default: %(default)s)')
    output = parser.parse_args(args).output
    start = time.monotonic()
    with tqdm(unit='part', disable=not sys.stderr.isatty()) as bar:
        def tell(line: str) -> None:
            bar.set_description(line, refresh=False)
            bar.update()
            if bar.disable:
                print(line, file=sys.stderr, flush=True)

        found = study(tell)
    seconds = round(time.monotonic() - start, 1)
    summary = {'package_version': __version__, 'wall_seconds': seconds, **found.summary()}
    write_figures(output / 'summary.json', summary)
    figures = draw(found, output)
    write_report(found, figures, output / 'report.md')
    print(f'wrote {output}/report.md, summary.json and {len(figures)} figures in {seconds:.0f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
