# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A window of the trends that is zoomed is drawn as finely as the whole was."""

from pathlib import Path
import sys

import pytest

from koopman_ros.panel.trend_page import zoomed
from koopman_ros.testing import Harness
from support.browser import ADDRESS, opened_browser
from support.nodes import type_support

__all__ = ['type_support']

# as coarse as eight hours are, after seconds
COARSE = ('import sys; from koopman_ros.panel import trend_page; trend_page._BUCKETS = 20; '
          'from koopman_ros.nodes.panel import main; sys.exit(main())')
SHARE = """share => {
    const chart = document.querySelector('.nicegui-echart');
    const { xAxis, series } = getElement(parseInt(chart.id.slice(1))).chart.getOption();
    const { min, max } = xAxis[0], middle = (min + max) / 2, half = share * (max - min) / 2;
    return series[0].data.filter(([time]) => Math.abs(time - middle) < half).length;
}"""
ZOOM = """() => {
    const chart = document.querySelector('.nicegui-echart');
    getElement(parseInt(chart.id.slice(1))).chart.dispatchAction(
        {type: 'dataZoom', start: 40, end: 60});
}"""


def test_a_zoomed_window_has_as_many_values_as_the_whole_had(tmp_path: Path) -> None:
    with opened_browser() as browser, Harness(tmp_path, timeout=60.0) as ros:
        panel = ros.start('panel', {'port': 0}, command=(sys.executable, '-c', COARSE))
        # a limit on one side alone is drawn, too, and the chart goes on
        ros.start('controller', {'temperature.max': 60.0})
        # noise, so that lowest and highest values of a bucket are others than its first and last
        ros.start('plant', {'speed': 50.0, 'temperature.noise': 0.1})
        address = ros.wait_until(lambda: ADDRESS.search(panel.output()))
        assert address is not None
        with browser.page(f'{address[1]}/trends') as page:
            # the whole is thinned out: 20 buckets of up to four values
            page.wait_for_function(f'() => {{ const of = {SHARE}; return of(1) > 50; }}')
            page.wait_for_function(f'() => {{ const of = {SHARE}; return of(0.2) < 20; }}')
            page.evaluate(ZOOM)
            page.wait_for_function(f'() => {{ const of = {SHARE}; return of(0.2) > 30; }}')
        assert 'Traceback' not in panel.output()


@pytest.mark.parametrize(('told', 'found'), [
    ({'start': 25.0, 'end': 50}, (0.25, 0.5)), ({'batch': [{'start': 0, 'end': 100}]}, (0.0, 1.0)),
    ({'start': 50.0, 'end': 25.0}, None), ({'start': -1, 'end': 5}, None), ({}, None),
    ({'start': 'nan', 'end': 5}, None), ({'batch': 1}, None), (None, None), ([], None)])
def test_what_a_browser_says_of_a_window_is_checked(
        told: object, found: tuple[float, float] | None) -> None:
    assert zoomed(told) == found
