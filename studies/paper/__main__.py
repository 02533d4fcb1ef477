# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The paper's experiments, and those on data from a sensor: figures, tables and a report.

Run it as ``python -m studies.paper`` (needs the `train` and `demo` requirements).
"""

import argparse
from pathlib import Path
import signal
import sys
import time
from typing import Any

from studies.options import add_scheduler, add_seeds, read
from studies.paper.campaign import (
    conclude,
    run_campaign,
    SENSOR_EXPERIMENTS,
)
from studies.paper.figures import draw_figures
from studies.paper.report import write_report


def main(args: list[str] | None = None) -> int:
    """Run the experiments and write what they found."""
    parser = argparse.ArgumentParser(
        prog='python -m studies.paper',
        description="Reproduce the paper's experiments, or learn from sensor data, each from "
        'several seeds.')
    add_seeds(parser, 20)
    parser.add_argument('--sensors', action='store_true', help='learn from noisy, sampled data '
                        "instead of the paper's experiments")
    parser.add_argument('--output', type=Path, help='folder for figures and report (default: '
                        'out/studies, or out/studies-sensors)')
    add_scheduler(parser)
    options = read(parser, args)
    options.output = options.output or Path(
        'out/studies-sensors' if options.sensors else 'out/studies')
    # a request to end is an interrupt: what is done is reported
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    start = time.monotonic()
    campaign = run_campaign(options.seeds, SENSOR_EXPERIMENTS if options.sensors else None,
                            options.scheduler)

    def report(summary: dict[str, Any]) -> str:
        figures = draw_figures(campaign, options.output)
        write_report(summary, figures, options.output / 'report.md')
        return f'{len(figures)} figures'

    return conclude(campaign, options.seeds, start, options.output, report)


if __name__ == '__main__':
    sys.exit(main())
