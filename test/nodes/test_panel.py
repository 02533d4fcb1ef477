# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The panel node: visitors it serves, actions it forwards, and the loop without it."""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
import contextlib
import json
import math
from pathlib import Path
import re
import signal
import socket
import ssl
import subprocess
import threading
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import (
    build_opener,
    HTTPRedirectHandler,
    HTTPSHandler,
    Request,
)

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Temperature
from std_msgs.msg import String

from koopman_ros.demo import reactor
from koopman_ros.nodes import panel
from koopman_ros.nodes.panel import PanelNode
from koopman_ros.panel import requests
from koopman_ros.panel.requests import Action, Answer
from koopman_ros.panel.snapshot import CONTROLLER, TRAINER
from koopman_ros.ros import remote_node, topics
from koopman_ros.ros.controller_status import TASKS
from koopman_ros.testing import Harness, NodeProcess
from support.browser import ADDRESS
from support.nodes import complaint, run_here, temperature, TIMEOUT, value
from support.users import write_users


def address(ros: Harness, process: NodeProcess) -> str:
    return ros.wait_until(lambda: ADDRESS.search(process.output()))[1]


class _Stay(HTTPRedirectHandler):
    def redirect_request(self, *_: Any) -> None:
        return None


def get(url: str, data: bytes | None = None, trusting: ssl.SSLContext | None = None,
        **headers: str) -> tuple[int, str, Any]:
    """Return status, text and headers of a page, or of what it is rejected with."""
    request = Request(url, data, {name.replace('_', '-'): text for name, text in headers.items()})
    try:
        opener = build_opener(_Stay, HTTPSHandler(context=trusting))
        with opener.open(request, timeout=TIMEOUT) as answer:
            return answer.status, answer.read().decode(), answer.headers
    except HTTPError as error:
        return error.code, error.read().decode(), error.headers


# Visitors.


def test_pages_are_served_to_this_machine_alone_and_a_port_only_once(
        ros: Harness, capfd: pytest.CaptureFixture[str]) -> None:
    url = address(ros, ros.start('panel', {'port': 0}))
    for path in ('/', '/trends', '/alarms', '/model', '/tuning', '/audit'):
        status, text, headers = get(f'{url}{path}')
        assert status == 200
        assert not re.findall(r'(?:src|href)="?(?:https?:)?//', text)
        assert headers['x-frame-options'] == 'DENY'
    assert get(url, Origin=url)[0] == 200
    # two panels of two loops do not look the same
    other = address(ros, ros.start('panel', {'port': 0}, ('-r', '__ns:=/line_2')))
    assert '<title>Overview – line_2 reactor</title>' in get(other)[1]
    assert '<title>Overview – reactor</title>' in get(url)[1]
    for headers in ({'Origin': 'http://elsewhere'}, {'Host': 'elsewhere.example'}):
        status, text, _ = get(url, **headers)
        assert status == 403
        assert text.startswith('rejected: ')
    # browsers always say the origin
    assert [opened(url, *origin) for origin in (
        ('Origin: http://elsewhere',), (), (f'Origin: {url}',))] == ['403', '403', '101']
    port = url.rpartition(':')[2]
    assert run_here(panel, port=port) == 1
    assert f'port {port} (' in complaint(capfd)


def opened(url: str, *headers: str) -> str:
    """Return the status with which a WebSocket is answered."""
    host, _, port = url.removeprefix('http://').partition(':')
    with socket.create_connection((host, int(port)), TIMEOUT) as stream:
        stream.sendall('\r\n'.join((
            'GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1',
            f'Host: {host}:{port}', 'Connection: Upgrade', 'Upgrade: websocket',
            'Sec-WebSocket-Version: 13', 'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==',
            *headers, '', '')).encode())
        return stream.recv(4096).split()[1].decode()


@pytest.mark.parametrize(('parameters', 'words'), [
    ({'host': '0.0.0.0'}, "'0.0.0.0' requires passwords"),
    ({'users': 'nowhere'}, "users = 'nowhere' cannot be read"),
    ({'alarm_file': '/proc/alarms'}, "alarm_file = '/proc/alarms'"),
    ({'trusted_proxy': '[proxy.example]'}, "trusted_proxy = 'proxy.example' must be an address"),
    ({'trusted_proxy': '[127.0.0.1]'}, 'trusted_proxy requires users'),
    ({'tls_certificate': 'here.pem'}, 'tls_certificate and tls_key'),
    ({'tls_certificate': 'a.pem', 'tls_key': 'b.pem'}, "tls_certificate = 'a.pem'"),
    ({'temperature.shown_unit': 'm'}, "temperature.shown_unit = 'm' must have the dimension"),
    ({'controlled': '[nothing]'}, "controlled = ['nothing'] must name"),
])
def test_a_bad_parameter_is_named_in_one_line(
        capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
        parameters: dict[str, object], words: str) -> None:
    destroyed: list[PanelNode] = []
    destroy = PanelNode.destroy_node

    def noted(own: PanelNode) -> None:
        destroyed.append(own)
        destroy(own)

    monkeypatch.setattr(PanelNode, 'destroy_node', noted)
    assert run_here(panel, **parameters) == 1
    found = complaint(capfd)
    assert found.startswith('panel: cannot start: ')
    assert words in found
    # a node that got as far as its subscriptions listens no more
    assert all(not list(own.subscriptions) for own in destroyed)


def test_users_log_in_over_tls_alone_and_wrong_passwords_wait(
        ros: Harness, tmp_path: Path) -> None:
    key, certificate = tmp_path / 'key.pem', tmp_path / 'panel.pem'
    users = write_users(tmp_path / 'users')
    subprocess.run(
        ['openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256',
         '-nodes', '-days', '2', '-subj', '/CN=127.0.0.1', '-addext',
         'subjectAltName=IP:127.0.0.1', '-keyout', str(key), '-out', str(certificate)],
        check=True, capture_output=True)
    process = ros.start('panel', {'port': 0, 'host': '0.0.0.0', 'users': users,
                                  'tls_certificate': certificate, 'tls_key': key})
    found = ros.wait_until(lambda: re.search(r'at https://0\.0\.0\.0:(\d+)', process.output()))
    url = f'https://127.0.0.1:{found[1]}'
    # only who knows its certificate takes it for the panel
    with pytest.raises(URLError, match='certificate verify failed'):
        get(f'{url}/login')
    trusting = ssl.create_default_context(cafile=str(certificate))
    status, _, headers = get(url, None, trusting)
    assert (status, headers['location']) == (303, '/login')
    assert get(f'{url}/_nicegui_ws/socket.io/?EIO=4&transport=polling', None, trusting)[0] == 401
    right = b'name=anna&password=correct+horse'
    kind = {'Content_Type': 'application/x-www-form-urlencoded', 'Origin': url}
    # a page of the same name without encryption is another origin
    for origin in ('http://elsewhere', url.replace('https', 'http')):
        assert get(f'{url}/login', right, trusting, **{**kind, 'Origin': origin})[0] == 403
    status, text, _ = get(f'{url}/login', b'name=%3Cb%3E&password=x', trusting, **kind)
    assert status == 401
    assert '<b>' not in text
    status, _, headers = get(f'{url}/login', right, trusting, **kind)
    assert (status, headers['location']) == (303, '/')
    cookie, *rules = headers['set-cookie'].split('; ')
    assert {'httponly', 'samesite=strict', 'path=/', 'secure'} <= set(rules)
    assert get(url, None, trusting, Cookie=cookie)[0] == 200
    assert get(f'{url}/logout', None, trusting, Cookie=cookie)[0] == 303
    assert get(url, None, trusting, Cookie=cookie)[0] == 303
    # from this address
    answers = [get(f'{url}/login', b'name=anna&password=wrong', trusting, **kind)[0]
               for _ in range(6)]
    assert answers[-1] == 429
    assert set(answers) == {401, 429}
    # nothing is said in clear
    with socket.create_connection(('127.0.0.1', int(found[1])), TIMEOUT) as stream:
        stream.sendall(b'GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n')
        assert b'login' not in stream.recv(4096)


# Actions.


class Panel:
    """A panel in this process, without its pages, beside processes of a harness."""

    def __init__(self, ros: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
        class Nothing:
            address, pages = '', 0

            def stop(self) -> None:
                pass

        monkeypatch.setattr(PanelNode, '_serve', lambda _: Nothing())
        # on a busy machine
        monkeypatch.setattr(requests, 'TIMEOUT', TIMEOUT)
        # of the two one in the usual unit
        rclpy.init(args=['--ros-args', '-p', 'coolant_temperature.shown_unit:=degF'])
        self.ros, self.panel = ros, PanelNode()
        (self.loop,) = self.panel.loops.values()
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.panel)
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.spin)
        self.thread.start()

    def spin(self) -> None:
        # an executor that is shut down while it waits may fail
        while not self.over.is_set():
            self.executor.spin_once(0.1)

    def wait(self, condition: Callable[[], Any]) -> Any:
        return self.ros.wait_until(condition)

    def ask(self, what: str, name: str = '', number: Any = None) -> Answer:
        future: Future[Answer] = self.loop.request(Action('anna', what, name, number))
        self.wait(future.done)
        return future.result()

    def close(self) -> None:
        self.over.set()
        self.thread.join()
        self.executor.shutdown()
        self.panel.complete()
        self.panel.destroy_node()
        rclpy.shutdown()


def test_requests_of_the_panel_are_executed_and_audited(
        ros: Harness, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    controller = ros.start('controller')
    trainer = ros.start('trainer', {'output': tmp_path / 'bag'})
    ask = ros.speak(Temperature, reactor.SETPOINT, to='controller', subscribers=2)
    reports: list[DiagnosticArray] = ros.listen(DiagnosticArray, topics.DIAGNOSTICS)
    heard: list[Temperature] = ros.listen(Temperature, reactor.TEMPERATURE)
    # the controller, the trainer and this test miss nothing
    ros.start('plant', {'speed': 50.0, 'lockstep': True, 'lockstep_subscribers': 3})
    ros.wait_until(lambda: len(heard) > 50)
    ask.publish(temperature(45.0))
    ros.wait_until(lambda: len(heard) > 200)
    ros.node.destroy_publisher(ask)
    reports_are_whole(ros, reports)
    desk = Panel(ros, monkeypatch)
    try:
        asks_for_all_that_there_is(desk, controller)
        # one that hangs is not told from a lost one by starting another
        monkeypatch.setattr(remote_node, 'TIMEOUT', 1.0)
        trainer.process.send_signal(signal.SIGSTOP)
        assert 'did not answer within 1 s' in desk.ask('cancel', TRAINER).text
        trainer.process.send_signal(signal.SIGCONT)
    finally:
        desk.close()


def reports_are_whole(ros: Harness, reports: list[DiagnosticArray]) -> None:
    """Each node reports all its tasks in one message, and names the plant."""
    wanted = {tuple(f'{node}: {task}' for task in tasks) for node, tasks in (
        ('plant', ('simulation',)), ('controller', TASKS),
        ('trainer', ('recording', 'experiment', 'training')))}
    ros.wait_until(lambda: wanted <= {
        tuple(status.name for status in report.status) for report in reports})
    assert {status.hardware_id for report in reports for status in report.status} == {
        'one-state reactor'}


def asks_for_all_that_there_is(desk: Panel, controller: NodeProcess) -> None:
    loop, ros = desk.loop, desk.ros
    actions: list[String] = ros.listen(String, topics.AUDIT_LOG)
    (publisher,) = (one for one in desk.panel.publishers
                    if one.topic_name == f'/{topics.AUDIT_LOG}')
    # the trainer records them, too
    desk.wait(lambda: publisher.get_subscription_count() >= 2)
    desk.wait(lambda: loop.snapshot.mode == 'automatic' and not loop.snapshot.silences
              and len(loop.snapshot.parameters.get(TRAINER, ())) > 20
              and loop.snapshot.states[0].training and math.isfinite(loop.snapshot.time))
    # a set-point that is accepted, and one that is not
    assert desk.ask('setpoint', reactor.TEMPERATURE, 46.0) == Answer(True, 'accepted')
    desk.wait(lambda: loop.snapshot.states[0].setpoint == pytest.approx(46.0))
    rejected = desk.ask('setpoint', reactor.TEMPERATURE, 80.0)
    assert re.fullmatch(
        r'rejected: outside 31\.85 to 53\.85 degC, the trained range', str(rejected))
    # one that the controller would read as no number
    assert '-273.15 to 10000 degC' in desk.ask('setpoint', reactor.TEMPERATURE, -1e5).text
    # nobody is in the way of an experiment
    desk.wait(lambda: not ros.node.count_publishers(reactor.SETPOINT))
    # manual mode and back
    assert not desk.ask('manual', reactor.COOLANT_TEMPERATURE, 68.0).accepted
    assert desk.ask('automatic', CONTROLLER, False) == Answer(True, 'manual mode')
    assert desk.ask('manual', reactor.COOLANT_TEMPERATURE, 100.0) == Answer(
        True, 'limited to 89.6 °F')
    assert desk.ask('manual', reactor.COOLANT_TEMPERATURE, 68.0) == Answer(True, 'accepted')
    desk.wait(lambda: loop.snapshot.inputs[0].command == pytest.approx(68.0))
    assert loop.snapshot.mode == 'manual'
    assert desk.ask('automatic', CONTROLLER, True).accepted
    assert 'not latched' in desk.ask('clear safe state', CONTROLLER).text
    # parameters
    assert desk.ask('parameters', CONTROLLER, {'coolant_temperature.max': 30.0}).accepted
    desk.wait(lambda: loop.snapshot.inputs[0].limits == pytest.approx((41.0, 86.0)))
    rejected = desk.ask('parameters', CONTROLLER, {'coolant_temperature.max': 4.0})
    assert 'coolant_temperature.min = 5.0 degC must be below' in rejected.text
    # services of the trainer
    assert desk.ask('record', TRAINER, False).accepted
    assert desk.ask('cancel', TRAINER) == Answer(False, 'not training')
    # each with its person, before the value and after
    desk.wait(lambda: {
        ('set-point', 'temperature 45 → 46 °C by anna'), ('mode', 'automatic → manual by anna'),
        ('parameter', 'coolant_temperature.max: 32 → 30 by anna')} <= {
        (mark.kind, mark.text) for mark in loop.view.trends.marks(0.0, 1e12)})
    assert controller.stop() == 0
    desk.wait(lambda: not desk.panel.count_publishers(topics.EVENT_LOG))
    assert desk.ask('setpoint', reactor.TEMPERATURE, 45.0) == Answer(
        False, 'the controller is not running: start it')

    def audited(at: int) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(actions[at].data)
        return found

    # the last one, which comes after that to cancel a training
    ros.wait_until(lambda: len(actions) >= 12 and audited(-1)['what'] != 'cancel trainer')
    first, last = audited(0), audited(-1)
    assert (first['who'], first['what']) == ('anna', 'setpoint temperature')
    assert (first['new'], first['unit'], first['accepted'], first['answer']) == (
        46.0, 'degC', True, 'accepted')
    assert (last['what'], last['accepted']) == ('setpoint temperature', False)


# The loop without it.


def test_the_loop_continues_while_the_panel_is_flooded_stopped_and_killed(
        ros: Harness) -> None:
    process = ros.start('panel', {'port': 0})
    ros.start('controller')
    # as fast as it can
    ros.start('plant', {'lockstep': True, 'lockstep_subscribers': 3, 'speed': 0.0})
    commands: list[Temperature] = ros.listen(Temperature, reactor.COOLANT_SETPOINT)
    ros.listen(Temperature, reactor.TEMPERATURE)
    ros.wait_until(lambda: commands)
    flood(ros, address(ros, process), lambda: len(commands) > 60)
    # more than a queue holds
    process.process.send_signal(signal.SIGSTOP)
    seen = len(commands)
    ros.wait_until(lambda: len(commands) > seen + 200)
    process.told_to_end = True
    process.process.kill()
    process.wait()
    seen = len(commands)
    ros.wait_until(lambda: len(commands) > seen + 50)
    status = ros.wait_for_status('controller: control', lambda s: int(
        value(s, 'measurements')) > 310)
    assert status.level == DiagnosticStatus.OK
    assert status.message.startswith('automatic')
    assert value(status, 'missed measurements') == value(status, 'late measurements') == '0'


def flood(ros: Harness, url: str, enough: Callable[[], bool]) -> None:
    """Ask for pages again and again, beside many who never say what they want."""
    host, _, port = url.removeprefix('http://').partition(':')
    over, answered = threading.Event(), Counter[int]()

    def ask() -> None:
        while not over.is_set():
            answered[get(url)[0]] += 1

    with contextlib.ExitStack() as stack:
        # whatever they are let in for
        for _ in range(200):
            idle = stack.enter_context(socket.create_connection((host, int(port)), TIMEOUT))
            idle.sendall(b'GET / HTTP/1.1\r\nHost: ')
        askers = [threading.Thread(target=ask) for _ in range(4)]
        for asker in askers:
            asker.start()
        try:
            ros.wait_until(lambda: enough() and answered.total() > 20)
        finally:
            over.set()
            for asker in askers:
                asker.join()
    assert set(answered) == {200}
