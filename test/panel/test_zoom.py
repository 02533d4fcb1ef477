# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Trends in a browser: an hour that was before, and a window of it that is zoomed."""

import math
from pathlib import Path
import sys

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import pytest
from rclpy.serialization import serialize_message

from koopman_ros.bags import BagWriter, message_definition
from koopman_ros.panel.trend_page import zoomed
from koopman_ros.ros import topics
from koopman_ros.testing import Harness
from koopman_ros.units import NANOSECONDS
from support.browser import ADDRESS, opened_browser
from support.nodes import temperature, type_support

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
DATA = """() => {
    const chart = document.querySelector('.nicegui-echart');
    if (!chart) return [];
    const { series } = getElement(parseInt(chart.id.slice(1))).chart.getOption();
    return series.length ? series[0].data : [];
}"""
SAMPLES, BEGIN = 36_000, 10_000.0  # and s
PEAK, DIP, HIGHEST, LOWEST = 12_345, 23_456, 70.25, 30.5  # samples and degC
ZOOM = """() => {
    const chart = document.querySelector('.nicegui-echart');
    getElement(parseInt(chart.id.slice(1))).chart.dispatchAction(
        {type: 'dataZoom', start: 40, end: 60});
}"""


def an_hour(folder: Path) -> Path:
    """Record an hour at 10 Hz as a trainer would, with a peak and a dip of one sample each."""
    with BagWriter(folder) as writer:
        writer.add_topic('/temperature', message_definition('sensor_msgs/msg/Temperature'))
        for k in range(SAMPLES):
            celsius = {PEAK: HIGHEST, DIP: LOWEST}.get(k, 48.0 + math.sin(0.01 * k))
            stamp = BEGIN + 0.1 * k
            writer.write('/temperature', serialize_message(temperature(celsius, stamp)),
                         round(stamp * NANOSECONDS))
    return folder


def test_an_hour_is_drawn_to_a_page_that_comes_late_and_finely_where_it_is_zoomed(
        tmp_path: Path) -> None:
    bag = an_hour(tmp_path / 'hour')
    with opened_browser() as browser, Harness(tmp_path, timeout=60.0, imported=True) as ros:
        panel = ros.start('panel', {'port': 0}, command=(sys.executable, '-c', COARSE))
        recording = ros.node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        said = DiagnosticArray(status=[DiagnosticStatus(
            name='trainer: recording', values=[KeyValue(key='bag', value=str(bag))])])
        # a limit on one side alone is drawn, too, and the chart goes on
        ros.start('controller', {'mpc.temperature.max': 60.0})
        ros.start('plant', {'speed': 2.0, 'start_time': BEGIN + 0.1 * SAMPLES})
        address = ros.wait_until(lambda: ADDRESS.search(panel.output()))
        assert address is not None
        # it comes late, and finds a bag that is being recorded
        clock = ros.node.create_timer(0.5, lambda: recording.publish(said))
        with browser.page(f'{address[1]}/trends') as page:
            page.get_by_role('button', name='1 h', exact=True).click()

            def drawn() -> list[list[float]]:
                ros.spin_once(0.2)
                found: list[list[float]] = page.evaluate(DATA)
                return found if found and found[-1][0] - found[0][0] > 3500e3 else []

            values = [value for _, value in ros.wait_until(drawn) if value is not None]
            # the whole is thinned out: 20 buckets of up to four values
            assert 50 < len(values) < 100
            # and yet nothing of a tenth of a second is lost
            assert (max(values), min(values)) == pytest.approx((HIGHEST, LOWEST))
            # the same to whoever comes again
            page.reload()
            page.get_by_role('button', name='1 h', exact=True).click()
            page.wait_for_function(f'() => {{ const of = {DATA}; const found = of(); '
                                   'return found.length && found.at(-1)[0] - found[0][0] > 3500e3'
                                   '; }')
            page.wait_for_function(f'() => {{ const of = {SHARE}; return of(0.2) < 20; }}')
            # a window that is zoomed has as many values as the whole had
            page.evaluate(ZOOM)
            page.wait_for_function(f'() => {{ const of = {SHARE}; return of(0.2) > 30; }}')
        ros.node.destroy_timer(clock)
        assert 'Traceback' not in panel.output()


def test_without_chromium_it_is_said_how_to_get_it(
        monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv('PATH', str(tmp_path))
    with pytest.raises(pytest.fail.Exception, match='sudo apt-get install chromium'), (
            opened_browser()):
        pass


@pytest.mark.parametrize(('told', 'found'), [
    ({'start': 25.0, 'end': 50}, (0.25, 0.5)), ({'batch': [{'start': 0, 'end': 100}]}, (0.0, 1.0)),
    ({'start': 50.0, 'end': 25.0}, None), ({'start': -1, 'end': 5}, None), ({}, None),
    ({'start': 'nan', 'end': 5}, None), ({'batch': 1}, None), (None, None), ([], None)])
def test_what_a_browser_says_of_a_window_is_checked(
        told: object, found: tuple[float, float] | None) -> None:
    assert zoomed(told) == found
