# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Run the study (needs the `train`, `demo` and `bench` requirements): report."""

import sys

from studies.campaign import conclude, read_options, run_campaign
from studies.general.report import write_report
from studies.general.study import EXPERIMENTS


def main(args: list[str] | None = None) -> int:
    """Run the study and write the report."""
    options = read_options(
        args, 'studies.general', 'Apply the law on models of several classes to plants that it '
        'was not made for.', 'out/studies-general', 10, 'joblib', EXPERIMENTS)
    names = options.plants or list(EXPERIMENTS)
    return conclude(
        options.seeds, options.output, lambda: run_campaign(
            options.seeds, {name: EXPERIMENTS[name] for name in names}, options.scheduler),
        lambda _, summary: write_report(summary, options.output))


if __name__ == '__main__':
    sys.exit(main())
