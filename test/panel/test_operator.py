# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What an operator sees and does, in a real browser, of a loop whose messages a test sends."""

from collections.abc import Iterator
import contextlib
import csv
from pathlib import Path
import re
import time
from typing import Any

from playwright.sync_api import BrowserContext, expect, Locator, Page, WebSocketRoute
import pytest

from koopman_ros.core.paths import model_path
from koopman_ros.panel import conditions
from koopman_ros.panel.history import HistoryFile
from koopman_ros.panel.requests import Action, Answer, UNKNOWN
from koopman_ros.panel.snapshot import CONTROLLER, ERROR, OK, PLANT, WARN
from koopman_ros.parameters.panel import ProcessLimits
from support.browser import Pages, PATIENCE, repeat_until
from support.operated import OperatedLoop
from support.users import PASSWORDS

# NiceGUI looks through all objects of the process for its server, also those of torch where
# another test has imported it.
pytestmark = pytest.mark.filterwarnings('ignore:.torch.distributed.reduce_op. is:FutureWarning')

DESK = (1000, 700)  # pixels


class Desk:
    """A browser in which an engineer is logged in, and the loop that its pages show."""

    def __init__(self, browser: Pages, served: Any, name: str = 'anna') -> None:
        expect.set_options(timeout=PATIENCE / 4.0)
        self._served, self.url = served, served.server.address
        self.context: BrowserContext = browser.context(*DESK)
        served.loop = OperatedLoop()
        page = self.context.new_page()
        page.goto(f'{self.url}/login')
        page.get_by_label('Name').fill(name)
        page.get_by_label('Password').fill(PASSWORDS[name])
        page.keyboard.press('Enter')
        page.wait_for_url(f'{self.url}/')
        page.close()

    @contextlib.contextmanager
    def page(self, path: str = '/', loop: OperatedLoop | None = None, *,
             routed: Any = None) -> Iterator[tuple[OperatedLoop, Page]]:
        """Show a page of a new loop."""
        self._served.loop = loop or OperatedLoop()
        page = self.context.new_page()
        if routed:
            page.route_web_socket('**', routed)
        page.goto(f'{self.url}{path}')
        page.wait_for_selector('#beat[data-beat]')
        try:
            yield self._served.loop, page
        finally:
            page.close()


@pytest.fixture(scope='module')
def desk(browser: Pages, served: Any) -> Iterator[Desk]:
    own = Desk(browser, served)
    yield own
    own.context.close()
    browser.forgive()


def asked(page: Page) -> Locator:
    return page.get_by_label('Set-point of temperature, °C', exact=True)


def face(page: Page, signal: str) -> Locator:
    return page.locator(f'[data-signal={signal}]')


def ready(page: Page) -> None:
    page.wait_for_function('window.did_handshake')
    expect(asked(page)).to_have_value(re.compile(r'\d'))


class Wire:
    """
    The connection of a page, which a test interrupts: messages wait, as in a network.

    :ivar cut: whether messages wait.
    :ivar held: whether those of the page wait, and those to it pass.
    """

    def __init__(self) -> None:
        self.cut = self.held = False
        self._waiting: list[Any] = []

    def __call__(self, route: WebSocketRoute) -> None:
        server = route.connect_to_server()
        route.on_message(lambda text: self._pass(server.send, text, self.cut or self.held))
        server.on_message(lambda text: self._pass(route.send, text, self.cut))

    def _pass(self, send: Any, text: Any, wait: bool) -> None:
        if wait:
            self._waiting.append((send, text))
        else:
            send(text)

    def mend(self) -> None:
        self.cut = self.held = False
        while self._waiting:
            send, text = self._waiting.pop(0)
            send(text)


def test_a_command_of_an_interrupted_connection_is_not_carried_out_and_the_page_says_so(
        desk: Desk) -> None:
    wire = Wire()
    with desk.page(routed=wire) as (loop, page):
        ready(page)
        asked(page).fill('46')
        asked(page).press('Enter')
        answer = face(page, 'temperature').locator('.answer')
        expect(answer).to_have_text('accepted')
        expect(asked(page)).to_have_value('46.0')
        wire.cut = True
        asked(page).fill('38')
        expect(face(page, 'temperature').locator('.ask')).to_have_class(re.compile('typed'))
        asked(page).press('Enter')
        # the answer to the one before is gone at once
        expect(answer).to_have_class(re.compile('pending'), timeout=500.0)
        expect(page.locator('#lost')).to_be_visible()
        page.wait_for_timeout(1500.0)
        wire.mend()
        expect(page.locator('#unsent')).to_contain_text(
            re.compile('Not sent: Set-point of temperature, °C = 38 '))
        expect(page.locator('#lost')).to_be_hidden()
        assert [action.value for action in loop.asked] == [46.0]
        # the value is still marked, and can be sent now
        expect(face(page, 'temperature').locator('.ask')).to_have_class(re.compile('typed'))
        asked(page).press('Enter')
        expect(face(page, 'temperature').locator('.value')).to_have_text('38.0 °C')
        page.get_by_role('button', name='Close').click()
        expect(page.locator('#unsent')).to_be_hidden()


def test_a_command_that_was_lost_is_named_after_the_page_was_loaded_again(desk: Desk) -> None:
    wire = Wire()
    with desk.page(routed=wire) as (loop, page):
        ready(page)
        wire.cut = True
        asked(page).fill('39')
        asked(page).press('Enter')
        expect(face(page, 'temperature').locator('.answer')).to_have_class(re.compile('pending'))
        wire.cut = False
        page.reload()
        expect(page.locator('#unsent')).to_contain_text('Not confirmed: Set-point of temperature')
        expect(asked(page)).to_have_value('45.0')
        assert not loop.asked


def test_an_answer_ends_when_another_set_point_holds(desk: Desk) -> None:
    with desk.page() as (loop, page):
        ready(page)
        asked(page).fill('46')
        asked(page).press('Enter')
        answer = face(page, 'temperature').locator('.answer')
        expect(answer).to_have_text('accepted')
        page.wait_for_timeout(2500.0)
        expect(answer).to_have_text('accepted')
        loop.request(Action('otto', 'setpoint', 'temperature', 47.0))
        expect(answer).to_have_text('')


def texts(where: Locator) -> list[str]:
    return where.get_by_role('listitem').all_inner_texts()


def test_each_event_has_its_own_time_values_and_person(desk: Desk) -> None:
    with desk.page('/trends') as (loop, page):
        events = page.get_by_role('list', name='Events')
        for who, value in (('otto', 46.0), ('olga', 46.5)):
            loop.request(Action(who, 'setpoint', 'temperature', value))
        expect(events).to_contain_text('set-point: temperature 45 → 46 °C by otto')
        expect(events).to_contain_text('set-point: temperature 46 → 46.5 °C by olga')
        page.goto(f'{desk.url}/audit')
        actions = page.get_by_role('list', name='Actions')
        expect(actions).to_contain_text('otto: set-point temperature 46: accepted')
        with page.expect_download() as download:
            page.get_by_role('button', name='Export CSV').click()
        rows = list(csv.DictReader(Path(download.value.path()).read_text().splitlines()))
        assert [(row['who'], row['new'], row['accepted']) for row in rows] == [
            ('otto', '46', 'True'), ('olga', '46.5', 'True')]
        page.get_by_label('Filter').fill('olga')
        expect(actions.get_by_role('listitem')).to_have_count(1)


def alarm(page: Page, said: str) -> Locator:
    return page.get_by_role('list', name='Active alarms').get_by_role('listitem').filter(
        has_text=said)


def test_another_fault_of_one_status_is_another_alarm(desk: Desk) -> None:
    with desk.page('/alarms') as (loop, page):
        loop.status('pump: bearing', WARN, 'bearing at 81 degC')
        warm = alarm(page, 'bearing at')
        warm.get_by_role('button', name='Acknowledge: pump: bearing at 81 °C').click()
        expect(warm).to_contain_text('acknowledged by anna')
        loop.status('pump: bearing', WARN, 'bearing at 82 degC')
        expect(alarm(page, '82 °C')).to_contain_text('acknowledged by anna')
        loop.status('pump: bearing', WARN, 'oil low')
        expect(alarm(page, 'oil low')).to_contain_text(', unacknowledged')
        expect(page.get_by_label('Last 24 hours')).to_contain_text(
            'raised: pump: bearing: oil low')


def test_the_most_urgent_alarm_is_on_every_page_and_in_the_title(desk: Desk) -> None:
    with desk.page('/tuning') as (loop, page):
        counts = page.locator('.counts')
        expect(counts).to_have_text('No alarms')
        top = page.locator('.tabs').bounding_box()
        loop.status('pump: bearing', WARN, 'bearing warm')
        loop.status('pump: motor', ERROR, 'motor tripped')
        strip = page.get_by_role('list', name='Most urgent alarm')
        expect(strip).to_contain_text('motor tripped')
        expect(strip).to_contain_text('HIGH')
        expect(counts).to_have_text('2 unacknowledged · 2 active')
        expect(page).to_have_title(re.compile(r'^■ HIGH \(2\) Tuning'))
        # nothing below has moved
        assert page.locator('.tabs').bounding_box() == top
        sound = page.get_by_role('button', name='Sound')
        expect(sound).to_have_attribute('aria-pressed', 'false')
        sound.click()
        expect(sound).to_have_attribute('aria-pressed', 'true')
        sound.click()
        strip.get_by_role('button', name='Acknowledge: pump: motor tripped').click()
        expect(strip).to_contain_text('bearing warm')
        for key in ('pump: bearing: bearing warm', 'pump: motor: motor tripped'):
            assert loop.view.alarms.shelve(key, 600.0, 'otto', time.time())
        expect(counts).to_have_text('2 shelved')


def test_a_click_does_nothing_on_a_row_that_has_just_moved(desk: Desk) -> None:
    with desk.page('/alarms') as (loop, page):
        loop.status('pump: bearing', WARN, 'bearing warm')
        low = alarm(page, 'bearing warm')
        button = low.get_by_role('button', name='Acknowledge')
        expect(button).to_be_enabled()
        page.wait_for_timeout(800.0)
        box = button.bounding_box()
        assert box is not None
        loop.status('pump: motor', ERROR, 'motor tripped')
        # the click comes as the row of the other alarm takes the place
        page.evaluate("""([x, y]) => new Promise(done => {
            const list = document.querySelector('[aria-label="Active alarms"]');
            new MutationObserver((_, own) => {
                if (!list.innerText.includes('motor')) return;
                own.disconnect();
                setTimeout(() => { document.elementFromPoint(x, y)?.click(); done(); }, 50);
            }).observe(list, {subtree: true, childList: true, characterData: true});
        })""", [box['x'] + 10.0, box['y'] + 10.0])
        page.wait_for_timeout(700.0)
        expect(alarm(page, 'motor tripped')).to_contain_text(', unacknowledged')
        expect(low).to_contain_text(', unacknowledged')
        alarm(page, 'motor').get_by_role('button', name='Acknowledge').click()
        expect(alarm(page, 'motor')).to_contain_text('acknowledged by anna')


def test_models_are_compared_on_the_same_data_with_what_their_ranges_gain_and_lose(
        desk: Desk) -> None:
    loop = OperatedLoop()
    new = str(model_path('reactor_nz4'))
    figures = {'accepted': 'True', 'model_file': new, 'units: temperature': 'K',
               'heldout_error: temperature': '0.410000038'}
    loop.status('trainer: training', OK, 'done', {
        **figures, 'heldout_error_of_current_model: temperature': '1.7'})
    with desk.page('/model', loop) as (_, page):
        activate = page.get_by_role('button', name='Activate the new model …')
        activate.click()
        dialog = page.get_by_role('dialog')
        expect(dialog).to_contain_text('Error on the new record, temperature [K]')
        expect(dialog.locator('.changes')).to_contain_text(re.compile(r'1\.7\s*0\.41$'))
        expect(dialog).to_contain_text('lost by the new model')
        assert 'Held-out' not in dialog.inner_text()
        page.keyboard.press('Escape')
        # the training compared with a model that is no longer the active one
        loop.control['model'] = 'another'
        expect(page.get_by_label('Model', exact=True)).to_contain_text('another')
        activate.click()
        expect(dialog).to_contain_text('Error on the same data')
        expect(dialog).to_contain_text('not known')
        assert '1.7' not in dialog.inner_text()
        page.keyboard.press('Escape')


def test_an_experiment_is_on_every_page_and_a_set_point_asks_before_it_ends_it(
        desk: Desk) -> None:
    with desk.page('/model') as (loop, page):
        experiment = page.get_by_label('Experiment', exact=True)
        page.get_by_role('button', name='Start …').click()
        dialog = page.get_by_role('dialog')
        expect(dialog).to_contain_text('temperature: set-points 40 °C to 50 °C')
        # the bounds of steps of the coolant do not hold for steps of set-points
        expect(dialog).to_contain_text('coolant: moved by the controller within its limits, '
                                       '5.0 to 32.0 °C')
        assert '10 °C' not in dialog.inner_text()
        page.keyboard.press('Escape')
        loop.status('trainer: experiment', OK, 'running', {
            'topic': '/setpoint', 'left [s]': '812'})
        expect(experiment.get_by_role('button', name='End')).to_be_enabled()
        for path in ('/trends', '/'):
            page.goto(f'{desk.url}{path}')
            expect(page.locator('header')).to_contain_text('EXPERIMENT, 812 s left')
        ready(page)
        asked(page).fill('46')
        asked(page).press('Enter')
        expect(dialog).to_contain_text('Abort the experiment?')
        page.get_by_role('button', name='Cancel').click()
        expect(face(page, 'temperature').locator('.answer')).to_contain_text('not sent')
        assert not loop.asked
        asked(page).fill('46')
        asked(page).press('Enter')
        page.get_by_role('button', name='Abort the experiment').click()
        expect(face(page, 'temperature').locator('.answer')).to_have_text('accepted')


def test_limits_are_for_engineers_and_are_confirmed(
        desk: Desk, browser: Pages, served: Any) -> None:
    with desk.page('/tuning') as (loop, page):
        def row() -> Locator:
            page.get_by_label('Parameters of the controller').get_by_text(
                'coolant', exact=True).click()
            return page.locator('[data-parameter="coolant.max"]')

        own = row()
        own.get_by_role('textbox').fill('1000')
        own.get_by_role('textbox').press('Enter')
        dialog = page.get_by_role('dialog')
        expect(dialog.locator('.changes')).to_contain_text(re.compile(r'32 °C\s*1000 °C'))
        page.keyboard.press('Escape')
        expect(own.locator('.answer')).to_have_text('not changed')
        assert not loop.asked
        own.get_by_role('textbox').press('Enter')
        dialog.get_by_role('button', name='Change').click()
        expect(own.locator('.answer')).to_have_text('accepted')
        assert [action.value for action in loop.asked] == [{'coolant.max': 1000.0}]
    operator = Desk(browser, served, 'olga')
    with contextlib.closing(operator.context), operator.page('/tuning') as (loop, page):
        page.get_by_label('Parameters of the controller').get_by_text(
            'coolant', exact=True).click()
        own = page.locator('[data-parameter="coolant.max"]')
        expect(own.get_by_role('textbox')).to_be_disabled()
        expect(own.get_by_role('button')).to_have_attribute('title', re.compile('engineer'))
        page.goto(operator.url)
        ready(page)
        asked(page).fill('46')
        asked(page).press('Enter')
        expect(face(page, 'temperature').locator('.answer')).to_have_text('accepted')


def test_bad_quality_is_shown_at_each_value(desk: Desk) -> None:
    with desk.page() as (loop, page):
        ready(page)
        temperature, coolant = face(page, 'temperature'), face(page, 'coolant')
        abnormal = temperature.locator('.abnormal')
        loop.control['rejected measurements'] = 'temperature'
        expect(abnormal).to_have_text('▲ measurement rejected')
        del loop.control['rejected measurements']
        expect(abnormal).to_be_hidden()
        loop.applied = 27.0
        expect(coolant.locator('.abnormal')).to_have_text('▲ applied differs from the command')
        loop.applied = 20.0
        loop.level = 'hold'
        expect(coolant.locator('.abnormal')).to_contain_text('held')
        loop.level = 'sdre'
        expect(coolant.locator('.abnormal')).to_be_hidden()
        loop.control['dead time [s]'] = '45'
        expect(coolant).to_contain_text('dead time 45 s')
        for role, shown in ((PLANT, coolant.locator('.value')),
                            (CONTROLLER, temperature.locator('.value'))):
            loop.silent.add(role)
            expect(shown).to_have_class(re.compile(r'\bold\b'))
            expect(shown).to_have_text(re.compile(r'^\? '))
            expect(temperature).to_contain_text('? model prediction 47')
            expect(temperature.get_by_role('button', name='Set')).to_be_disabled()
            expect(asked(page)).to_be_disabled()
            loop.silent.remove(role)
            expect(shown).not_to_have_class(re.compile(r'\bold\b'))
            expect(asked(page)).to_be_enabled()


def test_a_measurement_beyond_its_limit_is_an_alarm(desk: Desk) -> None:
    loop = OperatedLoop()
    loop.measured = 51.0
    loop.view.limits = {'temperature': ProcessLimits(high=50.0, deviation=1.5)}
    with desk.page('/alarms', loop) as (_, page):
        expect(alarm(page, 'above its high limit 50 °C')).to_contain_text('HIGH')
        expect(alarm(page, 'from the set-point')).to_contain_text('MEDIUM')


def test_alarms_are_filtered_sorted_selected_and_grouped_under_their_cause(desk: Desk) -> None:
    with desk.page('/alarms') as (loop, page):
        rows = page.get_by_role('list', name='Active alarms').get_by_role('listitem')
        loop.status('controller: measurements', WARN, 'the last measurement is 9 s old')
        expect(rows).to_have_count(1)
        for task in ('set-point', 'model', 'actuators'):
            loop.status(f'controller: {task}', WARN, f'not good: {task}')
        loop.status('trainer: experiment', ERROR, 'aborted: no measurement')
        loop.status('pump: motor', ERROR, 'tripped')
        loop.status('pump: bearing', WARN, 'warm')
        expect(rows).to_have_count(7)
        cause = alarm(page, '9 s old')
        expect(cause).to_contain_text('cause of 4 more')
        expect(page.locator('.consequence')).to_have_count(4)
        expect(page.locator('.consequence').filter(has_text='pump')).to_have_count(0)
        # urgent ones of others are above
        expect(rows.first).to_contain_text('tripped')
        page.get_by_label('Filter').fill('pump')
        expect(rows).to_have_count(2)
        page.get_by_label('Filter').fill('')
        expect(rows).to_have_count(7)
        chosen = alarm(page, 'not good: model')
        chosen.get_by_role('checkbox').click()
        page.get_by_role('button', name='Acknowledge selected (1)').click()
        expect(chosen).to_contain_text('acknowledged by anna')
        page.get_by_label('Source').click()
        page.get_by_role('option', name='pump').click()
        expect(rows).to_have_count(2)
        page.get_by_role('button', name='Acknowledge all of pump').click()
        expect(rows.filter(has_text='acknowledged by anna')).to_have_count(2)
        page.get_by_label('Source').click()
        page.get_by_role('option', name='all').click()
        page.get_by_label('Order').click()
        page.get_by_role('option', name='oldest first').click()
        expect(rows.first).to_contain_text('first-out')
        expect(rows.first).to_contain_text('9 s old')


def test_alarms_of_a_vanished_node_are_stale_and_then_return(
        desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conditions, '_STALE', 1.0)
    monkeypatch.setattr(conditions, '_GONE', 4.0)
    with desk.page('/alarms') as (loop, page):
        loop.status('pump: motor', ERROR, 'tripped')
        tripped = alarm(page, 'tripped')
        expect(tripped).to_contain_text(', unacknowledged')
        assert 'stale' not in tripped.inner_text()
        loop.forget('pump: motor')
        expect(tripped).to_contain_text('stale: its node is silent')
        expect(tripped).to_contain_text('returned, not acknowledged')


def test_an_answer_that_does_not_come_is_unknown(desk: Desk) -> None:
    with desk.page() as (loop, page):
        ready(page)
        loop.answer = Answer(False, f'{UNKNOWN}the controller did not answer within 3 s')
        asked(page).fill('46')
        asked(page).press('Enter')
        expect(face(page, 'temperature').locator('.answer')).to_have_text(
            '✖ unknown: the controller did not answer within 3 s')
        page.goto(f'{desk.url}/audit')
        expect(page.get_by_role('list', name='Actions')).to_contain_text('46: ✖ unknown')


# Of each chart the names, dashes and values of its pens, and the dashes in its legend.
CHARTS = """() => {
    const chart = document.querySelector('.nicegui-echart');
    const { legend, series } = getElement(parseInt(chart.id.slice(1))).chart.getOption();
    return legend.map((one, at) => ({
        symbols: one.itemStyle.opacity,
        pens: series.filter(own => own.xAxisIndex === at).map(own => ({
            name: own.name, line: JSON.stringify(own.lineStyle.type),
            values: own.data.map(point => point[1]) }))}));
}"""


def test_trends_have_gaps_outlast_the_panel_and_say_what_is_not_live(
        desk: Desk, tmp_path: Path) -> None:
    loops = [OperatedLoop() for _ in range(2)]
    now, trends = time.time(), loops[0].view.trends
    pens = ('temperature', 'temperature set-point', 'temperature predicted', 'coolant command',
            'coolant applied')
    for pen in pens:
        for k in range(10):
            trends.add(pen, now - 100.0 + k, 33.0)
    loops[0].request(Action('otto', 'setpoint', 'temperature', 46.0))
    # a panel, and the one after it
    for loop in loops:
        HistoryFile(loop.view, tmp_path / 'history.npz', now)
    with desk.page('/trends', loops[1]) as (loop, page):
        expect(page.locator('canvas')).to_be_visible()

        def drawn() -> dict[str, list[float | None]]:
            return {pen['name'].rpartition(' [')[0]: pen['values']
                    for chart in page.evaluate(CHARTS) for pen in chart['pens']}

        repeat_until(lambda: all(drawn()[pen][-1:] == [latest] for pen, latest in (
            ('temperature', 47.0), ('coolant command', 20.0))),
            lambda: page.wait_for_timeout(100.0))
        for pen in pens:
            values = drawn()[pen]
            gap = values.index(None)
            assert set(values[:gap]) == {33.0}
            assert values[gap + 1] not in (None, 33.0)
        for chart in page.evaluate(CHARTS):
            lines = [pen['line'] for pen in chart['pens'] if 'planned' not in pen['name']]
            assert len(set(lines)) == len(lines) > 1
            # a symbol would hide them in the legend
            assert chart['symbols'] == 0
        past = page.get_by_text('NOT LIVE')
        expect(past).to_be_hidden()
        box = page.locator('canvas').bounding_box()
        assert box is not None
        page.mouse.move(box['x'] + 400.0, box['y'] + 150.0)
        page.mouse.wheel(0.0, -300.0)
        expect(past).to_be_visible()
        page.get_by_role('button', name='Now').click()
        expect(past).to_be_hidden()
        page.goto(f'{desk.url}/audit')
        expect(page.get_by_role('list', name='Actions')).to_contain_text('otto: set-point')


def test_what_a_person_types_stays_while_the_panel_sends_a_new_set_point(desk: Desk) -> None:
    wire = Wire()
    with desk.page(routed=wire) as (loop, page):
        ready(page)
        field, own = asked(page), face(page, 'temperature')
        # the panel sees a key after it has sent what it knew before
        wire.held = True
        field.fill('')
        for celsius, key in zip((43.0, 44.0, 46.0, 47.0), '46,4', strict=True):
            loop.request(Action('otto', 'setpoint', 'temperature', celsius))
            expect(own.locator('.value')).to_have_text(f'{celsius} °C')
            field.press_sequentially(key)
        expect(own.locator('.ask')).to_have_class(re.compile('typed'))
        wire.mend()
        field.press('Enter')
        expect(own.locator('.answer')).to_have_text('accepted')
        assert loop.asked[-1].value == 46.4
        # what is typed before the answer is shown stays, too
        for celsius in ('38', '39'):
            field.fill(celsius)
            field.press('Enter')
        expect(own.locator('.value')).to_have_text('39.0 °C')
        expect(field).to_have_value('39.0')
        # a node that is silent disables the entry, and what is typed is still there after it
        field.fill('41')
        loop.silent.add(CONTROLLER)
        expect(field).to_be_disabled()
        loop.silent.remove(CONTROLLER)
        expect(field).to_be_enabled()
        expect(field).to_have_value('41')


def test_an_entry_is_operated_by_keys_and_refuses_an_ambiguous_number(desk: Desk) -> None:
    with desk.page() as (loop, page):
        ready(page)
        own = face(page, 'temperature')
        # an arrow moves a number, so that there has to be one
        expect(asked(page)).to_have_value('45.0')
        asked(page).press('ArrowUp')
        expect(asked(page)).to_have_value('45.1')
        asked(page).press('Escape')
        expect(asked(page)).to_have_value('45.0')
        slider = own.get_by_role('slider')
        slider.focus()
        slider.press('ArrowRight')
        expect(asked(page)).to_have_value('45.1')
        slider.press('Enter')
        expect(own.locator('.value')).to_have_text('45.1 °C')
        for text in ('1,234', '1.234,5'):
            asked(page).fill(text)
            asked(page).press('Enter')
            expect(own.locator('.answer')).to_contain_text('two ways')
        asked(page).fill('46,85')
        asked(page).press('Enter')
        expect(own.locator('.value')).to_have_text('46.85 °C')
        assert [action.value for action in loop.asked] == [pytest.approx(45.1), 46.85]
        asked(page).press('Tab')
        expect(own.get_by_role('button', name='Set Set-point of temperature')).to_be_focused()
