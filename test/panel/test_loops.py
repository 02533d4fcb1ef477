# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Several loops of one panel, in a real browser."""

from collections.abc import Iterator
import os
from pathlib import Path
import re
import subprocess
import sys
import warnings

from playwright.sync_api import expect, Locator, Page
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.demo import reactor
from koopman_ros.testing import Harness
import support
from support.browser import ADDRESS, Pages, PATIENCE
from support.many_loops import ALARMED, LOST, NAMES

TESTS = Path(support.__file__).parents[1]


@pytest.fixture(scope='module')
def many() -> Iterator[str]:
    """Serve the pages of 40 loops, and yield their address."""
    expect.set_options(timeout=PATIENCE)
    with subprocess.Popen(
            [sys.executable, '-m', 'support.many_loops'], cwd=TESTS, text=True,
            env={**os.environ, 'PYTHONPATH': str(TESTS)}, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        found = ADDRESS.search(process.stdout.readline())
        assert found is not None
        yield found[1]
        assert process.stdin is not None
        process.stdin.close()
        process.wait(PATIENCE / 1e3)


def row(page: Page, namespace: str) -> Locator:
    return page.locator(f'tr[data-loop="{namespace.lstrip("/")}"]')


# Texts of a row that cover the one before.
OVERPRINTED = """() => [...document.querySelectorAll('.signals')].flatMap(row => {
    const boxes = [...row.children].filter(one => one.innerText).map(one => {
        const range = document.createRange();
        range.selectNodeContents(one);
        return [one.innerText, range.getBoundingClientRect()];
    });
    return boxes.slice(1).filter(([_, box], at) => {
        const before = boxes[at][1];
        return box.top < before.bottom && box.left < before.right && box.bottom > before.top;
    }).map(([text]) => text);
})"""


def test_forty_loops_are_in_one_page_with_the_state_of_each(many: str, browser: Pages) -> None:
    with browser.page(many) as page:
        expect(page.locator('tr[data-loop]')).to_have_count(40)
        for at in (0, 39):
            own = row(page, NAMES[at])
            expect(own).to_contain_text('AUTOMATIC')
            expect(own).to_contain_text('No alarms')
            expect(own.locator('.number').first).to_have_text(f'{47.0 + at / 10.0:.1f} °C')
            expect(own.locator('.number').last).to_have_text('set-point 45.0 °C')
        expect(row(page, ALARMED)).to_contain_text('■ HIGH')
        expect(row(page, ALARMED)).to_contain_text('motor tripped')
        expect(row(page, LOST)).to_contain_text('no message from the plant')
        expect(row(page, LOST).locator('.number').first).to_have_text(re.compile(r'^\? '))
        expect(page).to_have_title(re.compile(r'^■ HIGH \(\d\) Loops$'))
        for width in (1400, 1024, 390):
            page.set_viewport_size({'width': width, 'height': 900})
            assert page.evaluate('document.documentElement.scrollWidth') <= width
            assert page.evaluate(OVERPRINTED) == []
        # all of them on a large screen
        page.set_viewport_size({'width': 1920, 'height': 1600})
        expect(row(page, NAMES[-1])).to_be_in_viewport()


def test_a_press_goes_to_the_loop_that_is_shown(many: str, browser: Pages) -> None:
    with browser.page(many) as page:
        row(page, NAMES[1]).get_by_role('link', name='line_1/reactor_2').click()
        expect(page.locator('h1')).to_have_text('line_1/reactor_2')
        expect(page).to_have_title(re.compile('Overview – line_1/reactor_2$'))
        # the alarm of another loop is on this page as well
        loops = page.get_by_role('link', name=re.compile('^Loops: ■ HIGH'))
        expect(loops).to_be_visible()
        asked = page.get_by_label('Set-point of temperature, °C', exact=True)
        expect(asked).to_have_value('45.0')
        asked.fill('41.5')
        asked.press('Enter')
        expect(page.locator('[data-signal=temperature] .answer')).to_have_text('accepted')
        for name in ('Trends', 'Alarms', 'Model', 'Tuning', 'Audit'):
            page.get_by_role('link', name=name, exact=True).click()
            expect(page.locator('h1')).to_have_text('line_1/reactor_2')
            expect(page).to_have_title(re.compile(f'{name} – line_1/reactor_2$'))
        expect(page.get_by_role('list', name='Actions')).to_contain_text('41.5')
        loops.click()
        for name in NAMES:
            expect(row(page, name).locator('.number').last).to_contain_text(
                f'set-point {"41.5" if name == NAMES[1] else "45.0"} °C')


def test_an_alarm_is_acknowledged_in_its_own_loop(many: str, browser: Pages) -> None:
    with browser.page(f'{many}/loop{ALARMED}/alarms') as page:
        own = page.get_by_role('list', name='Active alarms').get_by_role('listitem').filter(
            has_text='motor tripped')
        own.get_by_role('button', name='Acknowledge').click()
        expect(own).to_contain_text('acknowledged by operator')
        page.goto(many)
        expect(row(page, ALARMED)).to_contain_text('1 active')
        expect(row(page, ALARMED)).not_to_contain_text('unacknowledged')


def test_nodes_of_two_loops_are_operated_by_one_panel(
        tmp_path: Path, browser: Pages) -> None:
    expect.set_options(timeout=PATIENCE)
    with warnings.catch_warnings():
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
    with Harness(tmp_path) as ros:
        panel = ros.start('panel', {'port': 0, 'loops': ['line_1', 'line_2']})
        heard = {}
        for name in ('line_1', 'line_2'):
            there = ('-r', f'__ns:=/{name}')
            ros.start('controller', {}, there)
            ros.start('plant', {'speed': 10.0}, there)
            heard[name] = ros.listen(Temperature, f'/{name}/{reactor.SETPOINT}')
        url = ros.wait_until(lambda: ADDRESS.search(panel.output()))[1]
        with browser.page(url) as page:
            for name in heard:
                expect(row(page, name)).to_contain_text('AUTOMATIC')
                expect(row(page, name).locator('.number').first).to_have_text(
                    re.compile(r'^\d+\.\d+ °C$'))
            row(page, 'line_2').get_by_role('link').first.click()
            expect(page.locator('h1')).to_have_text(re.compile('^line_2 '))
            asked = page.get_by_label('Set-point of temperature, °C', exact=True)
            expect(asked).to_have_value(re.compile(r'\d'))
            asked.fill('46.5')
            asked.press('Enter')
            expect(page.locator('[data-signal=temperature] .answer')).to_have_text('accepted')
            # parameters are those of the loop, too
            page.get_by_role('link', name='Tuning', exact=True).click()
            own = page.get_by_label('Parameters of the panel')
            own.get_by_role('button', name='Expand "temperature"').click()
            limit = own.locator('[data-parameter="temperature.alarm_high"]')
            limit.get_by_role('textbox').fill('20')
            limit.get_by_role('button').click()
            page.get_by_role('dialog').get_by_role('button', name='Change').click()
            expect(limit.locator('.answer')).to_have_text('set')
            page.get_by_role('link', name=re.compile('^Loops')).click()
            expect(row(page, 'line_2')).to_contain_text('set-point 46.5 °C')
            expect(row(page, 'line_1')).not_to_contain_text('set-point 46.5 °C')
        ros.wait_until(lambda: heard['line_2'])
        assert not heard['line_1']
        assert ros.get_parameters('/line_2/panel', 'temperature.alarm_high') == [20.0]
        assert ros.get_parameters('/line_1/panel', 'temperature.alarm_high') != [20.0]
        assert panel.stop() == 0
