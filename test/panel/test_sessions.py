# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Sessions, the limit of wrong log-ins, and origins."""

import threading
import time

import pytest

from koopman_ros.panel.origins import is_loopback, rejection
from koopman_ros.panel.requests import Role
from koopman_ros.panel.sessions import MAX_SESSIONS_OF_A_USER, Sessions, Throttle


class Clock:
    """Seconds that a test sets."""

    def __init__(self) -> None:
        self.now = 1_700_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    own = Clock()
    monkeypatch.setattr(time, 'time', own)
    return own


@pytest.fixture
def throttle(clock: Clock) -> Throttle:
    return Throttle()


def attempts(throttle: Throttle, count: int, address: str = '10.0.0.1', name: str = 'ada') -> int:
    """Return how many of so many attempts pass."""
    return sum(throttle.attempt(address, name) == 0.0 for _ in range(count))


def test_wrong_log_ins_wait(throttle: Throttle, clock: Clock) -> None:
    assert attempts(throttle, 10) == 5
    assert throttle.attempt('10.0.0.1', 'ada') == pytest.approx(60.0)
    clock.now += 61.0
    assert attempts(throttle, 10) == 5
    passed = 10
    for _ in range(59):
        clock.now += 61.0
        passed += attempts(throttle, 10)
    assert passed <= 40, 'in an hour'


def test_failed_logins_do_not_lock_out_other_addresses(throttle: Throttle, clock: Clock) -> None:
    for number in range(200):
        attempts(throttle, 10, f'10.0.1.{number}')
    assert attempts(throttle, 1) == 1
    # nor another name at its own, within reason
    assert attempts(throttle, 1, '10.0.1.1', 'bob') == 1
    for number in range(30):
        attempts(throttle, 1, '10.0.1.1', f'name {number}')
    assert attempts(throttle, 1, '10.0.1.1', 'eve') == 0


def test_a_right_password_frees_the_name_and_not_the_address(
        throttle: Throttle, clock: Clock) -> None:
    for _ in range(20):
        assert attempts(throttle, 1) == 1
        throttle.succeeded('10.0.0.1', 'ada')
    for number in range(30):
        attempts(throttle, 1, name=f'victim {number}')
    assert attempts(throttle, 1, name='bob') == 0
    # a user who was here before is not kept out by the other names, but by attempts with its own
    assert attempts(throttle, 10) == 5


def test_an_account_of_ones_own_does_not_free_guesses(throttle: Throttle, clock: Clock) -> None:
    passed = 0
    for second in range(3600):
        clock.now += 1.0
        if throttle.attempt('10.0.0.1', 'mallory') == 0.0:
            throttle.succeeded('10.0.0.1', 'mallory')
        passed += throttle.attempt('10.0.0.1', f'victim {second}') == 0.0
    assert passed <= 200


@pytest.mark.parametrize(('addresses', 'together'), [
    (['2001:db8::1', '2001:db8::2', '2001:db8:0:0:ffff::3'], True),
    (['2001:db8::1', '2001:db8:0:1::1'], False), (['10.0.0.1', '::ffff:10.0.0.1'], True),
    (['fe80::1%eth0', 'fe80::2%eth0'], True), (['nonsense', 'nonsense2'], False),
    (['x' * 100_000, 'x' * 100_001], True)])
def test_addresses_of_one_network_count_together(
        throttle: Throttle, addresses: list[str], together: bool) -> None:
    assert attempts(throttle, 5, addresses[0], 'b' * 100_000) == 5
    for address in addresses[1:]:
        assert (throttle.attempt(address, 'b' * 100_000) > 0.0) is together


def test_none_passes_while_others_are_verified(throttle: Throttle) -> None:
    passed, start = [], threading.Barrier(20)

    def attempt() -> None:
        start.wait()
        passed.append(attempts(throttle, 1))

    threads = [threading.Thread(target=attempt) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(passed) == 5


@pytest.fixture
def sessions(clock: Clock) -> Sessions:
    return Sessions(clock)


def test_a_session_is_found_by_its_id_until_it_is_closed(sessions: Sessions) -> None:
    ada, bob = sessions.open('ada', Role.OPERATOR), sessions.open('bob', Role.VIEWER)
    found = sessions.find(ada)
    assert found is not None
    assert (found.name, found.role) == ('ada', Role.OPERATOR)
    for other in (None, '', 'x' * 43, '\ud800', 7, ['x'], {}):
        assert sessions.find(other) is None
        sessions.close(other)
    sessions.close(ada)
    assert sessions.find(ada) is None
    assert sessions.find(bob)


@pytest.mark.parametrize(('steps', 'use', 'open_until'), [
    # s between two looks, whether they are use, s until the end
    (3599.0, True, 12 * 3600.0), (1800.0, False, 3600.0), (3600.0, True, 3600.0)])
def test_a_session_ends_without_use_and_after_half_a_day(
        sessions: Sessions, clock: Clock, steps: float, use: bool, open_until: float) -> None:
    begin, key = clock.now, sessions.open('ada', Role.OPERATOR)
    while sessions.find(key, use=use):
        clock.now += steps
    assert open_until <= clock.now - begin < open_until + steps


def test_the_sessions_of_a_user_are_bounded(sessions: Sessions) -> None:
    other = sessions.open('bob', Role.VIEWER)
    own = [sessions.open('ada', Role.OPERATOR) for _ in range(MAX_SESSIONS_OF_A_USER + 10)]
    assert [bool(sessions.find(key)) for key in own] == [False] * 10 + [
        True] * MAX_SESSIONS_OF_A_USER
    assert sessions.find(other)


@pytest.mark.parametrize(('kind', 'host', 'origin', 'scheme', 'users', 'word'), [
    ('http', '127.0.0.1:8080', None, 'http', False, ''),
    ('http', '127.0.0.1:8080', 'http://127.0.0.1:8080', 'http', False, ''),
    ('websocket', 'localhost:8080', 'http://localhost:8080', 'http', False, ''),
    ('http', '[::1]:8080', 'http://[::1]:8080', 'http', False, ''),
    ('websocket', 'panel.plant', 'https://panel.plant', 'https', True, ''),
    # a host name that was made to lead here
    *(('http', host, None, 'http', False, 'host name') for host in (
        'evil.example:8080', 'localhost.evil.example', '', 'localhost@evil.example', '[::1',
        'x' * 1000)),
    ('websocket', '127.0.0.1:8080', None, 'http', True, 'origin'),
    *((kind, '127.0.0.1:8080', origin, 'http', True, 'origin') for kind in ('http', 'websocket')
      for origin in (
          'null', '', 'http://', 'http://evil.example', 'http://127.0.0.1:8081',
          'http://127.0.0.1', 'http://127.0.0.1:8080.evil.example',
          'http://127.0.0.1:8080@evil.example', 'http://evil.example@127.0.0.1:8080',
          'http://localhost:8080', 'http://127.0.0.1:8080, http://evil.example')),
    ('http', '127.0.0.1:8080', 'http://127.0.0.1:8080', 'https', True, 'origin'),
    ('http', '127.0.0.1:8080', 'https://127.0.0.1:8080', 'http', True, 'trusted_proxy')])
def test_requests_of_other_hosts_and_origins_are_rejected(
        kind: str, host: str, origin: str | None, scheme: str, users: bool, word: str) -> None:
    found = rejection(kind, host, origin, scheme, users=users)
    assert word in found
    assert bool(word) is bool(found)


@pytest.mark.parametrize(('host', 'loopback'), [
    ('127.0.0.1', True), ('127.8.9.1', True), ('LocalHost', True), ('::1', True),
    ('::ffff:127.0.0.1', True), ('0.0.0.0', False), ('::', False), ('', False),
    ('10.0.0.1', False), ('::ffff:10.0.0.1', False), ('127.1', False),
    ('localhost.evil.example', False), ('127.0.0.1 ', False), ('0x7f000001', False)])
def test_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback
