# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `train`, `demo` and `bench` requirements): report and figure."""

import argparse
from pathlib import Path
import signal
import sys
import time
from typing import Any

from validation.general import coordinates
from validation.general.report import write_report
from validation.general.study import EXPERIMENTS
from validation.paper.campaign import add_scheduler, conclude, run_campaign


def main(args: list[str] | None = None) -> int:
    """Run the study and write what it found."""
    parser = argparse.ArgumentParser(
        prog='python -m validation.general',
        description='Hold the law on models of several classes to plants that it was not made '
        'for.')
    parser.add_argument('plants', nargs='*', metavar='plant', help='which: '
                        f'{", ".join(EXPERIMENTS)} (default: all)')
    parser.add_argument('--seeds', type=int, default=10, help='number of seeds, at least 1 '
                        '(default: %(default)s)')
    parser.add_argument('--output', type=Path, default=Path('out/studies-general'),
                        help='folder for figure and report (default: %(default)s)')
    add_scheduler(parser)
    options = parser.parse_args(args)
    if options.seeds < 1:
        parser.error(f'--seeds is {options.seeds}, must be at least 1')
    if unknown := set(options.plants) - EXPERIMENTS.keys():
        parser.error(f'there is no plant {", ".join(sorted(unknown))}: choose of '
                     f'{", ".join(EXPERIMENTS)}')
    # a request to end is an interrupt: what is done is reported
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    start = time.monotonic()
    names = options.plants or list(EXPERIMENTS)
    campaign = run_campaign(options.seeds, {name: EXPERIMENTS[name] for name in names},
                            options.scheduler)
    if campaign.complete:
        campaign.add(run_campaign(min(options.seeds, coordinates.SEEDS), {
            name: coordinates.EXPERIMENTS[name] for name in (
                f'{coordinates.PLACE}/{name}' for name in names)}, options.scheduler))

    def report(summary: dict[str, Any]) -> str:
        write_report(summary, options.output)
        return 'a figure'

    return conclude(campaign, options.seeds, start, options.output, report)


if __name__ == '__main__':
    sys.exit(main())
