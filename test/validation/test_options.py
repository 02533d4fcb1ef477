# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The options of the studies, and their work wherever it is done."""

import argparse

import pytest

from koopman_ros.execution import backend_of
from validation import options, saddle, unstable
from validation.robustness import __main__ as robustness
from validation.robustness import stability


def test_figures_are_the_same_wherever_they_are_computed():
    with backend_of('process') as backend:
        found, here = (options.over(one, stability.hottest_saved, stability.COOLANTS)
                       for one in (backend, None))
    assert found == here
    assert list(here) == list(stability.COOLANTS)


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
