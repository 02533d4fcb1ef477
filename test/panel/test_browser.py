# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The panel in a real browser, with a plant, a controller and a trainer."""

from collections.abc import Callable, Iterator
import contextlib
from dataclasses import dataclass, field, replace
import json
from pathlib import Path
import re
import signal
import time
import warnings

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from playwright.sync_api import expect, Locator, Page
from playwright.sync_api import TimeoutError as PlaywrightTimeout
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.demo import reactor
from koopman_ros.model import load, save
from koopman_ros.ros import topics
from koopman_ros.testing import Harness, NodeProcess
from support.browser import ADDRESS, opened_browser, Pages, PATIENCE, repeat_until
from support.nodes import value
from support.users import PASSWORDS, write_users

DESK = (1000, 600)  # pixels
PHONE = (390, 844)
# an experiment of a few seconds, and a training
TRAINER = {
    'model_class': 'polynomial', 'restarts': 1, 'identification_methods': ['weak_form'],
    'weak_form.windows': [20.0], 'record_at_start': False,
    'min_free_disk': 0.0, 'experiment_signal': 'setpoint',
    'experiment_length': 900.0, 'experiment_min_hold_time': 20.0, 'experiment_max_hold_time': 60.0,
    'temperature.setpoint_min': 40.0, 'temperature.setpoint_max': 50.0}
CLOSED = 13_000.0  # ms until the panel drops a closed page
TRIES = 3
MARKUP = '<script>document.title="caught"</script><b>bold</b>'


@dataclass
class Site:
    """A loop with a panel that has users, and a browser in which one of them is logged in."""

    ros: Harness
    browser: Pages
    url: str
    panel: NodeProcess
    controller: NodeProcess
    plant: NodeProcess
    model: Path  #: that the trainer writes
    actions: list[String]
    desk: Page = field(init=False)  #: of the operator

    def __post_init__(self) -> None:
        self.desk = self.browser.context(*DESK).new_page()

    @contextlib.contextmanager
    def page(self, path: str = '/') -> Iterator[Page]:
        """Show a page to the operator, which may be open from the test before."""
        try:
            if self.desk.url != f'{self.url}{path}':
                self.desk.goto(f'{self.url}{path}')
            if '/login' in self.desk.url:
                log_in(self.desk, 'anna')
            assert self.desk.url == f'{self.url}{path}'
            yield self.desk
        except BaseException:
            self.desk.goto('about:blank')
            raise


@pytest.fixture(scope='module')
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Start all nodes once: each test leaves them as it found them."""
    expect.set_options(timeout=PATIENCE)
    folder = tmp_path_factory.mktemp('browser')
    users, model = write_users(folder / 'users'), folder / 'new.safetensors'
    with warnings.catch_warnings():
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
    with opened_browser() as browser, Harness(folder) as ros:
        panel = ros.start('panel', {'port': 0, 'users': users})
        # a model is accepted although the present one predicts a plant that has changed
        controller = ros.start('controller', {'model_check_factor': 0.0})
        ros.start('trainer', {**TRAINER, 'output': folder / 'run.mcap', 'model_output': model})
        plant = ros.start('plant', {'speed': 10.0})
        actions: list[String] = ros.listen(String, topics.AUDIT_LOG)
        url = ros.wait_until(lambda: ADDRESS.search(panel.output()))[1]
        yield Site(ros, browser, url, panel, controller, plant, model, actions)


@pytest.fixture(autouse=True)
def quiet(site: Site) -> Iterator[None]:
    """No page complains in its console, or asks anybody but the panel."""
    yield
    site.browser.check()


def log_in(page: Page, name: str) -> None:
    page.get_by_label('Name').fill(name)
    page.get_by_label('Password').fill(PASSWORDS[name])
    page.keyboard.press('Enter')
    page.wait_for_selector('#beat[data-beat]')


def face(page: Page, signal: str) -> Locator:
    return page.locator(f'[data-signal={signal}]')


def asked(page: Page) -> Locator:
    return page.get_by_label('Set-point of temperature, °C', exact=True)


def ready(page: Page) -> None:
    """Wait until numbers are there, and the controls."""
    expect(face(page, 'temperature').locator('.big')).to_have_text(re.compile(r'\d+\.\d'))
    expect(asked(page)).to_have_value(re.compile(r'\d'))


def ask_setpoint(page: Page, celsius: str) -> Locator:
    asked(page).fill(celsius)
    asked(page).press('Enter')
    return face(page, 'temperature').locator('.answer')


def card(page: Page, name: str) -> Locator:
    return page.get_by_label(name, exact=True)


def press(where: Locator, name: str | re.Pattern[str]) -> None:
    where.get_by_role('button', name=name).click()


def confirmed(page: Page, yes: str, where: Locator, answer: str | re.Pattern[str]) -> None:
    """Confirm a question, and wait for the answer."""
    press(page.get_by_role('dialog'), yes)
    expect(where.locator('.answer')).to_have_text(answer)


# Words and numbers that are broken over two lines; paths may be.
BROKEN = """() => {
    const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), found = [];
    const range = document.createRange();
    while (texts.nextNode()) {
        const { data, parentElement } = texts.currentNode;
        if (parentElement.checkVisibility() && !data.includes('/')) {
            for (const word of data.matchAll(/([^\\s_-]|-(?=\\d))+/g)) {
                range.setStart(texts.currentNode, word.index);
                range.setEnd(texts.currentNode, word.index + word[0].length);
                const tops = [...range.getClientRects()].filter(box => box.width > 1).map(
                    box => box.top);
                if (Math.max(...tops) - Math.min(...tops) > 9) {
                    found.push(`${word[0]} in ${data}`);
                }
            }
        }
    }
    return found;
}"""


def fits(page: Page) -> None:
    """Assert that no page is wider than its window, and no word broken."""
    for width in (1400, 1024, 375):
        page.set_viewport_size({'width': width, 'height': 900})
        page.wait_for_function(f'document.documentElement.scrollWidth <= {width}')
        assert page.evaluate(BROKEN) == []
    page.set_viewport_size(dict(zip(('width', 'height'), DESK, strict=True)))


def activated(page: Page, button: str | re.Pattern[str], *shown: str, yes: str = 'Activate'
              ) -> None:
    """Activate a model; again if a busy machine did not read it in time."""
    model = card(page, 'Model')
    for _ in range(TRIES):
        press(model, button)
        for text in shown:
            expect(page.get_by_role('dialog')).to_contain_text(text)
        expect(model.locator('.answer')).to_have_text('')
        confirmed(page, yes, model, re.compile('^set$|is still being read after'))
        if model.locator('.answer').inner_text() == 'set':
            return
    raise AssertionError(f'the model was not read in {TRIES} tries')


def test_a_model_is_recorded_trained_compared_activated_and_replaced(site: Site) -> None:
    """A reactor with a fouled jacket, which a clean one replaces for the other tests."""
    ros = site.ros
    assert site.plant.stop() == 0
    site.plant = ros.start('plant', {
        'start_time': 10_000.0, 'speed': 100.0, 'lockstep': True, 'lockstep_subscribers': 3,
        'temperature.measurement_noise': 0.01,
        'constants.heat_transfer_coefficient': 0.8 * reactor.constant(
            'heat_transfer_coefficient')})
    with site.page('/model') as page:
        recording, training = card(page, 'Recording'), card(page, 'Training')
        expect(recording).to_contain_text('not recording')
        for where, name, why in (
                (recording, 'Stop', 'no recording is running'),
                (card(page, 'Experiment'), 'End', 'no experiment is running'),
                (training, 'Cancel', 'no training is running')):
            button = where.get_by_role('button', name=name)
            expect(button).to_be_disabled()
            expect(button).to_have_attribute('title', why)
        press(recording, 'Record')
        expect(recording).to_contain_text('recording to')
        experiment = card(page, 'Experiment')
        expect(experiment).to_contain_text('steps: setpoint')
        press(experiment, 'Start …')
        expect(page.get_by_role('dialog')).to_contain_text('set-points 40 °C to 50 °C')
        confirmed(page, 'Start the experiment', experiment, re.compile('^(?!.*rejected).+'))

        def recorded() -> int:
            status = ros.wait_for_status('trainer: recording', lambda status: any(
                one.key == 'messages on /temperature' for one in status.values))
            return int(value(status, 'messages on /temperature'))

        begun = recorded()
        ros.wait_until(lambda: recorded() > begun + 420)
        press(recording, 'Stop')
        expect(recording).to_contain_text('not recording')
        # nothing moves while the models are computed
        assert site.plant.stop() == 0
        press(training, 'Train')
        expect(training).to_contain_text('is accepted', timeout=5.0 * PATIENCE)
        report = card(page, 'Report')
        expect(report).to_contain_text('The new model is accepted.')
        expect(report.locator('img.picture')).to_be_visible()
        picture = page.request.get(f'{site.url}/picture/training')
        assert (picture.status, picture.headers['content-type']) == (200, 'image/png')
        assert picture.body() == site.model.with_suffix('.png').read_bytes()
        for other in ('secret', '..%2f..%2fetc%2fpasswd', ''):
            assert page.request.get(f'{site.url}/picture/{other}').status == 404
        assert '_' not in training.inner_text().replace(str(site.model), '')
        comparison = card(page, 'Comparison')
        expect(comparison).not_to_contain_text('compared at')
        press(comparison, 'Compare on the last hour')
        press(comparison, 'Cancel')
        expect(comparison).to_contain_text('✖ cancelled')
        press(comparison, 'Compare on the last hour')
        expect(comparison).to_contain_text('The recorded commands are reproduced.',
                                           timeout=5.0 * PATIENCE)
        expect(comparison.locator('img.picture')).to_be_visible()
        commands = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
        site.plant = ros.start('plant', {'speed': 10.0, 'start_time': 20_000.0})
        ros.wait_until(lambda: commands and commands[-1].header.stamp.sec > 20_020)
        # the last set-point of the experiment may be outside the range of what was recorded
        page.goto(f'{site.url}/')
        ready(page)
        expect(ask_setpoint(page, '46')).to_have_text('accepted')
        page.goto(f'{site.url}/model')
        model = card(page, 'Model')
        activated(page, 'Activate the new model …', 'Training range, temperature [°C]',
                  'identity lift, n_z = 4', 'polynomial', 'accepted',
                  'Error on the new record, temperature [K]')
        expect(model.locator('.value')).to_have_text(str(site.model))
        expect(model).to_contain_text('polynomial')
        press(model, re.compile('Back to reactor'))
        fits(page)
        page.keyboard.press('Escape')
        activated(page, re.compile('Back to reactor'))
        expect(model.locator('.value')).to_have_text(re.compile('^reactor'))
        # one that training rejected needs force, which ends with it
        bad = site.model.with_name('bad.safetensors')
        accepted = load(site.model)
        save(replace(accepted, provenance=replace(
            accepted.provenance, accepted=False, reasons=('too inaccurate',))), bad)
        for force, name in ((True, str(bad)), (False, 'reactor_nz4')):
            # again if a busy machine did not read it in time
            ros.wait_until(lambda force=force, name=name: ros.set_parameters_atomically(
                'controller', load_rejected_model=force, model=name).successful)
        # the panel knows of it
        page.goto(f'{site.url}/tuning')
        page.wait_for_function('window.did_handshake')
        card(page, 'Parameters of the controller').get_by_text('general', exact=True).click()
        expect(page.locator('[data-parameter="load_rejected_model"]').get_by_role(
            'combobox')).to_have_value('false')
        page.goto(f'{site.url}/model')
        activated(page, re.compile('Back to .*bad'), 'rejected this model: too inaccurate',
                  'rejected', yes='Activate by force')
        ros.wait_until(lambda: ros.get_parameters('controller', 'load_rejected_model') == [False])
        activated(page, re.compile('Back to reactor'))
        # nor does force last where the page is closed before the controller responds
        press(model, re.compile('Back to .*bad'))
        site.controller.process.send_signal(signal.SIGSTOP)
        press(page.get_by_role('dialog'), 'Activate by force')
        expect(model.locator('.answer')).to_have_text('sent …')
        page.goto('about:blank')
        page.wait_for_timeout(CLOSED)
        site.controller.process.send_signal(signal.SIGCONT)
        ros.wait_until(lambda: ros.get_parameters(
            'controller', 'model', 'load_rejected_model') == [str(bad), False])
        page.goto(f'{site.url}/model')
        activated(page, re.compile('Back to reactor'))
        press(recording, 'Record')
        expect(recording).to_contain_text('recording to')
        # of the pictures that there are not
        site.browser.forgive()


def test_an_operator_logs_in_and_the_reactor_arrives_at_a_set_point(site: Site) -> None:
    with site.page() as page:
        expect(page.locator('header')).to_contain_text('anna')
        ready(page)
        own = face(page, 'temperature')
        asked(page).fill('')
        asked(page).press_sequentially('46,4')
        asked(page).press('Enter')
        expect(own.locator('.answer')).to_have_text('accepted')
        expect(own.locator('.value')).to_have_text('46.4 °C')
        expect(own.locator('.big')).to_have_text('46.4')
    site.ros.wait_until(lambda: any((said['who'], said['new']) == ('anna', 46.4) for said in (
        json.loads(message.data) for message in site.actions)))


def test_manual_mode_is_confirmed_and_left_again(site: Site) -> None:
    with site.page() as page:
        ready(page)
        switch = page.get_by_role('button', name='Switch to manual mode …')
        switch.click()
        dialog = page.get_by_role('dialog')
        expect(dialog).to_contain_text('In manual mode the set-point is not controlled.')
        # as this browser demands
        assert page.evaluate('document.getAnimations().length') == 0
        page.keyboard.press('Escape')
        expect(dialog).to_have_count(0)
        expect(page.locator('header')).to_contain_text('AUTOMATIC')
        switch.click()
        page.get_by_role('button', name='Switch to manual mode', exact=True).click()
        expect(page.locator('header')).to_contain_text('MANUAL')
        by_hand = page.get_by_label('Manual command: coolant temperature, °C', exact=True)
        by_hand.fill('21.5')
        by_hand.press('Enter')
        own = face(page, 'coolant_temperature')
        expect(own.locator('.answer')).to_have_text('accepted')
        expect(own.locator('.big')).to_have_text('21.5')
        by_hand.fill('45')
        by_hand.press('Enter')
        expect(own.locator('.answer')).to_have_text('limited to 32 °C')
        expect(by_hand).to_have_value('32.0')
        expect(own.get_by_role('slider')).to_have_value('32')
        expect(ask_setpoint(page, '47')).to_contain_text('only in automatic mode')
        fits(page)
        page.get_by_role('button', name='Switch to automatic mode').click()
        expect(page.locator('header')).to_contain_text('AUTOMATIC')


def standing(page: Page, said: str) -> Locator:
    return page.get_by_label('Active alarms').get_by_role('listitem').filter(has_text=said)


def press_row(button: Locator, acted: Callable[[], bool]) -> None:
    """Press a button of a row until it has acted: a row that has just moved ignores a press."""
    def act() -> None:
        with contextlib.suppress(PlaywrightTimeout):
            button.click(timeout=1000.0)
        button.page.wait_for_timeout(500.0)

    repeat_until(acted, act)


def test_an_alarm_is_raised_shelved_shown_again_acknowledged_and_gone(site: Site) -> None:
    """Beside one whose text is another's, in names and sentences of diagnostics: it stays text."""
    node = site.ros.node
    evil = node.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
    status = DiagnosticStatus(level=DiagnosticStatus.ERROR, name=MARKUP, message=MARKUP,
                              hardware_id=MARKUP)
    with site.page('/alarms') as page:
        # somebody commands the coolant beside the controller
        other = node.create_publisher(Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)
        try:
            said = 'controller: connections: 2 nodes command the coolant'
            own, row = standing(page, said), standing(page, MARKUP)
            deadline = time.monotonic() + PATIENCE / 1e3
            while not (own.is_visible() and row.is_visible()) and time.monotonic() < deadline:
                evil.publish(DiagnosticArray(status=[status]))
                site.ros.spin_once(0.2)
            expect(row).to_be_visible()
            assert 'caught' not in page.title()
            assert page.locator('b', has_text='bold').count() == 0
            status.level = DiagnosticStatus.OK
            evil.publish(DiagnosticArray(status=[status]))
            press_row(row.get_by_role('button', name='Acknowledge'), lambda: row.count() == 0)
            expect(own).to_contain_text('HIGH')
            fits(page)
            expect(page.get_by_role('link', name=re.compile(r'Alarms \(\d+\)'))).to_be_visible()
            expect(own.get_by_role('button', name='Shelve 8 h')).to_be_visible()
            press_row(own.get_by_role('button', name='Shelve 10 min'), lambda: own.count() == 0)
            shelved = page.get_by_label('Shelved alarms')
            expect(shelved).to_contain_text(said)
            press_row(
                shelved.get_by_role('button', name='Unshelve'), lambda: own.count() == 1)
            press_row(own.get_by_role('button', name='Acknowledge'),
                      lambda: 'acknowledged by anna' in own.inner_text())
        finally:
            node.destroy_publisher(other)
            node.destroy_publisher(evil)
        expect(row).to_have_count(0)
        expect(own).to_have_count(0)
        expect(page.get_by_label('Last 24 hours')).to_contain_text('acknowledged by anna')


def test_parameters_are_set_checked_and_rejected(site: Site) -> None:
    with site.page('/tuning') as page:
        own = page.get_by_label('Parameters of the controller')
        own.get_by_text('coolant temperature', exact=True).click()
        row = own.locator('[data-parameter="coolant_temperature.max"]')
        expect(row).to_contain_text('max [°C]')
        given = row.get_by_role('textbox')
        expect(given).to_have_value('32')
        for text, said in (('31', 'set'), ('x', "✖ rejected: 'x' is not a number"),
                           ('-300', re.compile('✖ rejected: coolant_temperature.max = -300.0 °C '
                                                'must be in ')),
                           ('4', re.compile('✖ rejected: coolant_temperature.min = 5.0 °C must '
                                            'be below')),
                           ('32', 'set')):
            given.fill(text)
            given.press('Enter')
            if text != 'x':
                press(page.get_by_role('dialog'), 'Change')
            expect(row.locator('.answer')).to_have_text(said)
        # parameters with a few possible values are lists
        for node, name, choices in (('trainer', 'experiment_signal', ('manual', 'setpoint')),
                                    ('controller', 'load_rejected_model', ('true', 'false'))):
            page.get_by_label(f'Parameters of the {node}').get_by_text(
                'general', exact=True).click()
            row = page.locator(f'[data-parameter="{name}"]')
            for choice in choices:
                row.get_by_role('combobox').click()
                page.get_by_role('option', name=choice, exact=True).click()
                # a click while it closes would open no other list
                expect(page.get_by_role('option')).to_have_count(0)
                press(row, f'Set {name}')
                press(page.get_by_role('dialog'), 'Change')
                expect(row.locator('.answer')).to_have_text('set')
                expect(row.get_by_role('combobox')).to_have_value(choice)

        def exported() -> str:
            with page.expect_download() as download:
                own.get_by_role('button', name='Export YAML').click()
            return Path(download.value.path()).read_text()

        # the controller tells of it a moment after it has answered
        deadline = time.monotonic() + PATIENCE / 1e3
        line = '    coolant_temperature.max: 32.0  # [degC]\n'
        while line not in (text := exported()) and time.monotonic() < deadline:
            page.wait_for_timeout(100.0)
        assert line in text
        assert text.startswith('/**/controller:\n  ros__parameters:\n')


# Controls that are not disabled.
USABLE = """controls => controls.filter(own => own.checkVisibility() && !own.matches(':disabled')
    && own.innerText !== 'Export YAML' && !own.closest('.view')).map(own => own.outerHTML)"""


def test_a_viewer_on_a_phone_sees_operator_actions_and_cannot_act(site: Site) -> None:
    phone = site.browser.context(*PHONE)
    with contextlib.closing(phone), site.page() as desk:
        page = phone.new_page()
        page.goto(site.url)
        assert page.url.endswith('/login')
        log_in(page, 'otto')
        expect(page.locator('header')).to_contain_text('otto (viewer)')
        ready(page)
        ready(desk)
        expect(ask_setpoint(desk, '48')).to_have_text('accepted')
        expect(face(page, 'temperature').locator('.value')).to_have_text('48.0 °C')
        expect(asked(page)).to_have_value('48.0')
        for path in ('/', '/trends', '/alarms', '/model', '/tuning', '/audit'):
            if path != '/':
                page.goto(f'{site.url}{path}')
                page.wait_for_selector('#beat[data-beat]')
            page.locator('.q-expansion-item .q-item:visible').evaluate_all(
                'groups => groups.forEach(group => group.click())')
            expect(page.locator('.q-expansion-item--collapsed:visible')).to_have_count(0)
            # nothing is scrolled sideways
            assert page.evaluate('document.documentElement.scrollWidth') <= PHONE[0]
            # of trends, a viewer may choose what to see
            if path != '/trends':
                controls = page.locator('.page button, .page input')
                assert controls.evaluate_all(USABLE) == []
        # logged out in another page, while this one is connected
        beat = page.locator('#beat')
        expect(beat).not_to_have_attribute('data-beat', beat.get_attribute('data-beat') or '')
        assert phone.request.get(f'{site.url}/logout').ok
        page.wait_for_url(re.compile(r'/login\?page=/audit$'))


def test_a_controller_that_is_gone_has_a_banner_until_it_is_back(site: Site) -> None:
    with site.page() as page:
        ready(page)
        site.controller.stop()
        banner = page.locator('.banner:not(#lost, #unsent)')
        expect(banner).to_have_text(re.compile(
            r'⚠ Connection lost: no message from the controller since \d\d:\d\d:\d\d'))
        expect(page.locator('header')).to_contain_text('MODE NOT KNOWN')
        fits(page)
        expect(asked(page)).to_be_disabled()
        for path, name in (('/tuning', 'Parameters of the controller'), ('/model', 'Model'),
                           ('/', 'Controller')):
            page.goto(f'{site.url}{path}')
            expect(card(page, name)).to_have_attribute('inert', '')
            expect(card(page, name).get_by_role('button', name='Export YAML', disabled=False)
                   ).to_have_count(0)
        site.controller = site.ros.start('controller')
        expect(banner).to_be_hidden()
        expect(page.locator('header')).to_contain_text('AUTOMATIC')
        expect(card(page, 'Controller')).not_to_have_attribute('inert', '')


def test_a_controller_that_was_killed_is_not_a_second_one(site: Site) -> None:
    """The middleware knows it for minutes."""
    with site.page() as page:
        ready(page)
        site.controller.stop(signal.SIGKILL)
        expect(page.locator('header')).to_contain_text('MODE NOT KNOWN')
        site.controller = site.ros.start('controller')
        expect(page.locator('header')).to_contain_text('AUTOMATIC')
        begun = len(site.ros.statuses)

        def of_plant() -> list[str]:
            return [status.message for status in site.ros.statuses[begun:]
                    if status.name == 'plant: simulation']

        site.ros.wait_until(lambda: len(of_plant()) > 3)
        assert not any('2 nodes' in message for message in of_plant())
        page.goto(f'{site.url}/alarms')
        expect(card(page, 'Active alarms')).not_to_contain_text('/controller, /controller')


def test_a_page_finds_its_panel_again(site: Site) -> None:
    """The one that comes back has no users: whoever reaches it is the operator."""
    port = int(site.url.rpartition(':')[2])
    with site.page() as page:
        ready(page)
        site.panel.stop()
        lost = page.locator('#lost')
        expect(lost).to_have_text(re.compile('Connection lost: no message from the panel since'))
        expect(lost).to_be_visible()
        site.panel = site.ros.start('panel', {'port': port})
        expect(lost).to_be_hidden()
        expect(page.locator('header')).to_contain_text('operator')
        ready(page)
        # of the connection that was rejected meanwhile
        site.browser.forgive()
