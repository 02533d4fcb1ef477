# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The options of the studies, and their work wherever it is done."""

import argparse

import pytest

from support.places import KINDS, places
from validation import options, saddle, unstable
from validation.robustness import __main__ as robustness
from validation.robustness.loop import reactor_controller, START
from validation.robustness.stability import margins_at


def test_figures_are_the_same_wherever_they_are_computed():
    def margins(bandwidth):
        return margins_at(reactor_controller(bandwidth=bandwidth), START)

    keys = (0.0, 6.0)
    expected = {key: margins(key) for key in keys}
    with places() as opened:
        for kind in KINDS:
            assert options.over(opened[kind], margins, keys) == expected


def test_a_plant_or_seeds_that_there_cannot_be(capsys):
    def parser():
        made = argparse.ArgumentParser()
        options.add_plants(made, ('tanks', 'reactor'))
        options.add_seeds(made)
        return made

    assert options.read(parser(), ['tanks'], ('tanks', 'reactor')).seeds == 10
    with pytest.raises(SystemExit):
        options.read(parser(), ['tank'], ('tanks', 'reactor'))
    assert 'there is no plant tank: choose of tanks, reactor' in capsys.readouterr().err
    with pytest.raises(SystemExit):
        options.read(parser(), ['--seeds', '0'])
    assert '--seeds is 0, must be at least 1' in capsys.readouterr().err


@pytest.mark.parametrize('study', [robustness, saddle, unstable])
def test_each_study_takes_a_scheduler(study):
    with pytest.raises(ValueError, match="scheduler is 'dask', must be empty for this process"):
        study.main(['--scheduler', 'dask'])
