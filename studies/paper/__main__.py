# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
The paper's experiments, and those on data from a sensor: figures, tables and a report.

Run it as ``python -m studies.paper`` (needs the `train` and `demo` requirements).
"""

from pathlib import Path
import sys
from typing import Any

from studies import campaign as campaigns
from studies.campaign import Campaign, Experiment, read_options, run_campaign
from studies.paper import reactor, scalar, sensors, two_state
from studies.paper.figures import draw_figures
from studies.paper.report import write_report

# Each experiment with the place of its figures in the summary; the slow ones first.
EXPERIMENTS: dict[str, Experiment] = {
    'reactor': reactor.run,
    'two_state': two_state.run,
    'narrow': two_state.run_narrow,
    'paper_algorithm/reactor': reactor.run_paper,
    'paper_algorithm/two_state': two_state.run_paper,
    'scalar': scalar.run,
}
# The same for what the paper leaves open: data from a sensor.
SENSOR_EXPERIMENTS: dict[str, Experiment] = {
    'sensors/drifted': sensors.run_drifted,
    'sensors/noisy': sensors.run_noisy,
    'sensors/noise_free': sensors.run_noise_free,
    'sensors/two_state': sensors.run_two_state,
}


def main(args: list[str] | None = None) -> int:
    """Run the experiments and write the report."""
    options = read_options(
        args, 'studies.paper', "Reproduce the paper's experiments, or learn from sensor data, "
        'each from several seeds.', 'out/studies', 20, 'joblib',
        flags={'sensors': "learn from noisy, sampled data instead of the paper's experiments "
                          '(default folder: out/studies-sensors)'})
    output: Path = options.output
    if options.sensors and output == Path('out/studies'):
        output = Path('out/studies-sensors')

    def report(campaign: Campaign, summary: dict[str, Any]) -> None:
        write_report(summary, draw_figures(campaign, output), output)

    return campaigns.conclude(options.seeds, output, lambda: run_campaign(
        options.seeds, SENSOR_EXPERIMENTS if options.sensors else EXPERIMENTS,
        options.scheduler), report)


if __name__ == '__main__':
    sys.exit(main())
