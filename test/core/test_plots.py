# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Pages, figures and pictures: their text, what JSON cannot hold, and what an error leaves."""

import json
import math

import numpy as np
import pytest

from koopman_ros.core import plots


def test_figures_hold_null_for_numbers_without_json_form(tmp_path):
    path = plots.write_figures(tmp_path / 'new' / 'summary.json', {
        'a': math.inf, 'b': [1, math.nan, {'c': (np.float64(-math.inf), True, None)}], 'd': 'NaN'})
    # what cannot be written leaves the old ones
    with pytest.raises(TypeError):
        plots.write_figures(path, {'what': object()})
    assert json.loads(path.read_text()) == {
        'a': None, 'b': [1, None, {'c': [None, True, None]}], 'd': 'NaN'}
    assert [file.name for file in path.parent.iterdir()] == ['summary.json']


@pytest.mark.parametrize(('name', 'unit', 'label'), [
    ('level_1', 'K', 'level 1 [°C]'), ('hidden_2', '1', 'unmeasured state 2'), ('x', '1', 'x'),
    ('hidden_valve', 'percent', 'hidden valve [%]')])
def test_an_axis_has_name_and_unit(name, unit, label):
    assert plots.axis_label(name, unit) == label


def test_a_drawing_is_written_when_its_block_ends_without_an_error(tmp_path):
    path = tmp_path / 'new' / 'picture.png'
    with pytest.raises(ZeroDivisionError), plots.drawing(path, size=(2.0, 2.0)):
        raise ZeroDivisionError
    with plots.drawing(path, 2, 1, size=(3.0, 3.0), sharex=True) as (figure, (upper, lower)):
        upper.plot([0.0, 1.0], label='seen')
        lower.plot([0.0, 1.0], label='seen')
        plots.draw_limits(lower, (0.2, 0.8), 'limits')
        plots.legend(figure, (upper, lower), 2)
        assert not path.exists()
    assert path.read_bytes().startswith(b'\x89PNG\r\n')
    (shown,) = figure.legends
    assert [text.get_text() for text in shown.get_texts()] == ['seen', 'limits']
