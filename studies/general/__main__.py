# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `train`, `demo` and `bench` requirements): report and figure."""

import argparse
import signal
import sys
import time
from typing import Any

from studies.general import coordinates
from studies.general.report import write_report
from studies.general.study import EXPERIMENTS
from studies.options import add_output, add_plants, add_scheduler, add_seeds, read
from studies.paper.campaign import conclude, run_campaign


def main(args: list[str] | None = None) -> int:
    """Run the study and write what it found."""
    parser = argparse.ArgumentParser(
        prog='python -m studies.general',
        description='Hold the law on models of several classes to plants that it was not made '
        'for.')
    add_plants(parser, EXPERIMENTS)
    add_seeds(parser)
    add_output(parser, 'out/studies-general')
    add_scheduler(parser)
    options = read(parser, args, EXPERIMENTS)
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
