# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `train`, `demo` and `bench` requirements): report and figures."""

from pathlib import Path
import sys
import time

from koopman_ros import __version__
from koopman_ros.core.plots import write_figures
from koopman_ros.execution import backend_of
from studies.campaign import read_options
from studies.robustness.report import write_report
from studies.robustness.study import study


def main(args: list[str] | None = None) -> int:
    """Run the study and write the report."""
    options = read_options(
        args, 'studies.robustness', 'Compute margins, region of attraction, disturbances, noise '
        'and the fallback of narrow data.', 'out/studies-robustness', scheduler='')
    output: Path = options.output
    start = time.monotonic()
    with backend_of(options.scheduler) as backend:
        figures, courses = study(backend)
    seconds = round(time.monotonic() - start, 1)
    write_figures(output / 'summary.json', {
        'package_version': __version__, 'wall_seconds': seconds, **figures})
    write_report(figures, courses, output)
    print(f'wrote {output}/report.md, summary.json and figures in {seconds:.0f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
