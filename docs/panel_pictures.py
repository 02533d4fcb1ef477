# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Take the pictures of the panel: ``make panel-pictures``, a minute, with Chromium."""

from pathlib import Path
import re
import shutil
import tempfile

from playwright.sync_api import sync_playwright
from sensor_msgs.msg import Temperature

from koopman_ros.demo import reactor
from koopman_ros.ros import topics
from koopman_ros.testing import Harness

FOLDER = Path(__file__).parent
SIZE = {'width': 1280, 'height': 960}  # pixels
TRAINER = {'model_class': 'polynomial', 'restarts': 1, 'experiment_signal': 'setpoint',
           'experiment_length': 900.0, 'experiment_min_hold_time': 20.0,
           'experiment_max_hold_time': 60.0}
ADDRESS = re.compile(r'the panel is at (\S+)')


def main() -> None:
    """Run the reactor with a panel, use each page, and save its picture."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright, Harness(
            Path(folder)) as ros:
        panel = ros.start('panel', {'port': 0})
        ros.start('controller')
        ros.start('trainer', {**TRAINER, 'output': f'{folder}/run.mcap',
                              'model_output': f'{folder}/new.safetensors'})
        # a jacket that has fouled since the current model was trained
        ros.start('plant', {'speed': 40.0, 'temperature.measurement_noise': 0.01,
                            'constants.heat_transfer_coefficient': 750.0})
        url = ros.wait_until(lambda: ADDRESS.search(panel.output()))[1]
        browser = playwright.chromium.launch(
            executable_path=shutil.which('chromium'), args=['--no-sandbox'])
        page = browser.new_context(viewport=SIZE).new_page()

        def picture(name: str) -> None:
            page.wait_for_timeout(3000.0)
            page.screenshot(path=FOLDER / f'panel_{name}.png')

        page.goto(f'{url}/model')
        page.get_by_role('button', name='Start …').click()
        page.get_by_role('button', name='Start the experiment').click()
        page.wait_for_timeout(25_000.0)
        for name in ('Stop', 'Train'):
            page.get_by_role('button', name=name, exact=True).click()
        page.get_by_text(re.compile('The new model is')).wait_for(timeout=600_000.0)
        page.get_by_label('Training', exact=True).evaluate('card => card.scrollIntoView()')
        picture('model')
        page.goto(url)
        entry = page.get_by_label('Set-point of temperature, °C', exact=True)
        for celsius in ('46', '50.5'):
            entry.fill(celsius)
            entry.press('Enter')
            page.wait_for_timeout(4000.0)
        picture('overview')
        page.goto(f'{url}/trends')
        picture('trends')
        page.goto(f'{url}/alarms')
        other = ros.node.create_publisher(Temperature, reactor.COOLANT_SETPOINT, topics.LOOP_QOS)
        active = page.get_by_role('list', name='Active alarms')
        active.get_by_role('button', name=re.compile('^Acknowledge:')).first.click()
        picture('alarms')
        ros.node.destroy_publisher(other)
        page.goto(f'{url}/tuning')
        page.get_by_text('coolant temperature', exact=True).first.click()
        picture('tuning')
        browser.close()


if __name__ == '__main__':
    main()
