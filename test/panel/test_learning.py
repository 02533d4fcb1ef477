# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Learning from the panel: record, train, read the report, compare, take over, and back."""

from pathlib import Path
import re
import warnings

from playwright.sync_api import expect, Locator, Page
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature

from koopman_ros.demo.reactor import constant
from koopman_ros.testing import Harness
from support.browser import ADDRESS, opened_browser, PATIENCE
from support.nodes import value

MEASUREMENTS = 420  # that are learned from
TRIES = 3


def card(page: Page, name: str) -> Locator:
    return page.get_by_label(name, exact=True)


def press(where: Locator, name: str | re.Pattern[str]) -> None:
    where.get_by_role('button', name=name).click()


def answered(page: Page, question: str, where: Locator, said: str | re.Pattern[str]) -> None:
    """Say yes to a question, and wait for what comes of it."""
    press(page.get_by_role('dialog'), question)
    expect(where.locator('.answer')).to_have_text(said, timeout=PATIENCE)


def taken_over(page: Page, model: Locator, button: str | re.Pattern[str]) -> None:
    """Say yes to a model; where a busy machine had not read it in time, again, as it says."""
    for _ in range(TRIES):
        answered(page, 'Take over', model, re.compile('^set$|is still being read after'))
        if model.locator('.answer').inner_text() == 'set':
            return
        # without the answer of before
        page.reload()
        press(model, button)
    raise AssertionError(f'the model was not read in {TRIES} tries')


def picture_of(where: Locator) -> list[int]:
    """Return width and height of a picture that the browser has drawn."""
    picture = where.locator('img.picture')
    expect(picture).to_be_visible(timeout=PATIENCE)
    found: list[int] = picture.evaluate(
        'async image => { await image.decode(); '
        'return [image.naturalWidth, image.naturalHeight]; }')
    return found


def test_a_model_is_learned_read_about_compared_and_takes_over(tmp_path: Path) -> None:
    """A reactor whose jacket has fouled, a hundred times as fast as the clock."""
    new = tmp_path / 'new.safetensors'
    with warnings.catch_warnings():
        # the parser of the type support imports a module that Python deprecated
        warnings.simplefilter('ignore', DeprecationWarning)
        serialize_message(Temperature())
    with opened_browser() as browser, Harness(tmp_path, timeout=60.0) as ros:
        panel = ros.start('panel', {'port': 0})
        # one that passes all models: what the old one predicts is off by as much as the jacket is
        ros.start('controller', {'model_check_factor': 0.0})
        ros.start('trainer', {
            'model_class': 'polynomial', 'training_starts': 1, 'record_at_start': False,
            'output': tmp_path / 'run.mcap', 'model_output': new, 'min_free_disk': 0.0,
            'experiment_on': 'setpoint', 'experiment_length': 900.0,
            'experiment_shortest_hold': 20.0, 'experiment_longest_hold': 60.0,
            'temperature.setpoint_min': 40.0, 'temperature.setpoint_max': 50.0})
        plant = {
            'lockstep': True, 'lockstep_subscribers': 3, 'temperature.noise': 0.01,
            'constants.heat_transfer_coefficient': 0.8 * constant('heat_transfer_coefficient')}
        quick = ros.start('plant', {**plant, 'speed': 100.0})
        address = ros.wait_until(lambda: ADDRESS.search(panel.output()))
        assert address is not None
        url = address[1]
        with browser.page(f'{url}/model') as page:
            recording, training = card(page, 'Recording'), card(page, 'Training')
            model = card(page, 'Model')
            expect(recording).to_contain_text('not recording', timeout=PATIENCE)
            press(recording, 'Record')
            expect(recording).to_contain_text(f'recording to {tmp_path}', timeout=PATIENCE)
            experiment = card(page, 'Experiment')
            expect(experiment).to_contain_text('steps: setpoint', timeout=PATIENCE)
            press(experiment, 'Start …')
            answered(page, 'Start the experiment', experiment, re.compile('^(?!.*refused).+'))
            # of the experiment, however long the page took to start it
            begun = int(value(ros.wait_for_status(
                'trainer: recording', lambda status: len(status.values) > 1),
                'messages on /temperature'))
            ros.wait_for_status('trainer: recording', lambda status: len(status.values) > 1 and (
                int(value(status, 'messages on /temperature')) > begun + MEASUREMENTS))
            # what follows needs a loop, and no quick one
            assert quick.stop() == 0
            ros.start('plant', {**plant, 'speed': 2.0, 'start_time': 10_000.0})
            press(recording, 'Stop')
            expect(recording).to_contain_text('not recording', timeout=PATIENCE)
            press(training, 'Train')
            expect(training.locator('.answer')).to_contain_text('training', timeout=PATIENCE)
            press(training, 'Cancel')
            expect(training).to_contain_text('cancelled, nothing was written', timeout=PATIENCE)
            press(training, 'Train')
            expect(training).to_contain_text(
                'is accepted', timeout=2.0 * PATIENCE)

            report = card(page, 'Report')
            expect(report).to_contain_text('the new model is accepted', timeout=PATIENCE)
            expect(report).to_contain_text('error on held-out records')
            assert picture_of(report) == list(_size(tmp_path / 'new.png'))
            picture = page.request.get(f'{url}/picture/training')
            assert (picture.status, picture.headers['content-type']) == (200, 'image/png')
            for other in ('secret', '..%2f..%2fetc%2fpasswd', ''):
                assert page.request.get(f'{url}/picture/{other}').status == 404

            comparison = card(page, 'Comparison')
            press(comparison, 'Compare on the last hour')
            press(comparison, 'Cancel')
            expect(comparison).to_contain_text('✖ cancelled', timeout=PATIENCE)
            press(comparison, 'Compare on the last hour')
            expect(comparison).to_contain_text(
                'the recorded commands are reproduced', timeout=5.0 * PATIENCE)
            expect(comparison).to_contain_text('commands compared')
            width, height = picture_of(comparison)
            assert (width, height > 500) == (1350, True)

            press(model, 'Take over the new one …')
            expect(page.get_by_role('dialog')).to_contain_text(f'Let {new} act?')
            taken_over(page, model, 'Take over the new one …')
            expect(model.locator('.value')).to_have_text(str(new), timeout=PATIENCE)
            press(model, re.compile('Back to reactor'))
            taken_over(page, model, re.compile('Back to reactor'))
            expect(model.locator('.value')).to_have_text(re.compile('^reactor'), timeout=PATIENCE)


def _size(picture: Path) -> tuple[int, int]:
    head = picture.read_bytes()[16:24]
    return int.from_bytes(head[:4], 'big'), int.from_bytes(head[4:], 'big')
