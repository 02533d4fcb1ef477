# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `train`, `demo` and `bench` requirements): report and figures."""

import argparse
from pathlib import Path
import sys
import time

from koopman_ros import __version__
from koopman_ros.execution import backend_of
from koopman_ros.reports import write_figures
from validation.options import add_output, add_scheduler, read
from validation.robustness.report import write_report
from validation.robustness.study import study


def main(args: list[str] | None = None) -> int:
    """Run the study and write what it found."""
    parser = argparse.ArgumentParser(
        prog='python -m validation.robustness',
        description='Compute margins, region of attraction, disturbances, noise and the guard '
        'against narrow data.')
    add_output(parser, 'out/studies-robustness')
    add_scheduler(parser, '')
    options = read(parser, args)
    output: Path = options.output
    start = time.monotonic()
    with backend_of(options.scheduler) as backend:
        found = study(lambda line: print(line, file=sys.stderr, flush=True), backend)
    seconds = round(time.monotonic() - start, 1)
    summary = {'package_version': __version__, 'wall_seconds': seconds, **found.figures}
    write_figures(output / 'summary.json', summary)
    write_report(found, output)
    print(f'wrote {output}/report.md, summary.json and figures in {seconds:.0f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
