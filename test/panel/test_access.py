# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Who may do what: passwords, the file of users, log-ins, sessions, origins, the command."""

import base64
from collections.abc import Iterator
import getpass
import os
from pathlib import Path
import stat
import subprocess
import sys
import threading

import pytest

from koopman_ros.panel import access
from koopman_ros.panel.access import (
    COST,
    Cost,
    hashed,
    is_loopback,
    main,
    may_be_addressed,
    needs_password,
    Role,
    same_origin,
    Sessions,
    Throttle,
    Users,
    write_user,
)

PASSWORD = 'correct horse'
#: for tests alone
QUICK = Cost(4, 1, 1)
# the same in all processes, whose tests are named after it
SECRET = ('scrypt$4$1$1$03ZC2Kb7mM0ImUMsCsfBnQ==$'
          'a5MN59oOFTgYyNQTb9JRNg/Kq5cvHQdcg3ktsu6doZU=')
SALT, DIGEST = base64.b64encode(bytes(16)).decode(), base64.b64encode(bytes(32)).decode()


class Clock:
    """Seconds that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / 'users'


def _write(file: Path, text: str | bytes, mode: int = 0o600) -> Path:
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    file.chmod(mode)
    return file


def _users(file: Path, *lines: str) -> Users:
    return Users.read(_write(file, ''.join(f'{line}\n' for line in lines)))


def test_a_password_is_hashed_at_the_cost_that_is_said(file: Path) -> None:
    secret = hashed(PASSWORD)
    assert secret.startswith(f'scrypt${COST.n}${COST.r}${COST.p}$')
    assert COST.n * COST.r * COST.p >= 2**14 * 8 * 5
    assert _users(file, f'ada:operator:{secret}').verify('ada', PASSWORD) is Role.OPERATOR


def test_hashes_of_one_password_differ() -> None:
    assert hashed(PASSWORD, QUICK) != hashed(PASSWORD, QUICK)
    assert PASSWORD not in hashed(PASSWORD, QUICK)


def test_a_hash_is_that_of_the_standard() -> None:
    # RFC 7914, section 12, the second
    digest = Cost(1024, 8, 16).digest('password', b'NaCl', 64)
    assert digest.hex().startswith('fdbabe1c9d3472007856e7190d01e9fe7c6ad7cbc8237830e77376634b37')


@pytest.mark.parametrize('password', ['', '1234567', 'x' * 1025, '12345678\0'])
def test_passwords_have_bounds(password: str) -> None:
    with pytest.raises(ValueError, match='a password must have 8 to 1024 characters'):
        hashed(password, QUICK)


@pytest.mark.parametrize(('name', 'password', 'role'), [
    ('ada', PASSWORD, Role.OPERATOR), ('bob', PASSWORD, Role.VIEWER),
    ('ada', 'correct hors', None), ('ada', PASSWORD + ' ', None), ('ada', '', None),
    ('eve', PASSWORD, None), ('', PASSWORD, None), ('ada:operator', PASSWORD, None),
    ('Ada', PASSWORD, None), ('ada\0', PASSWORD, None), ('ada', PASSWORD + '\0', None),
    ('ada', '\0' + PASSWORD, None), ('\ud800', '\ud800' * 10, None)])
def test_only_the_right_password_has_a_role(
        file: Path, name: str, password: str, role: Role | None) -> None:
    users = _users(file, f'ada:operator:{SECRET}', f'bob:viewer:{hashed(PASSWORD, QUICK)}')
    assert users.verify(name, password) is role


def test_huge_ones_are_refused_at_once(file: Path) -> None:
    users = _users(file, f'ada:operator:{SECRET}')
    huge = 'x' * 10_000_000
    assert users.verify('ada', huge) is None
    assert users.verify(huge, PASSWORD) is None


def test_characters_are_the_same_however_they_are_typed(file: Path) -> None:
    users = _users(file, f'Jürgen:viewer:{hashed("Schlüssel", QUICK)}')
    assert users.verify('Ju\u0308rgen', 'Schlu\u0308ssel') is Role.VIEWER


def test_an_unknown_name_takes_the_same_work(
        file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    users = _users(file, f'ada:operator:{SECRET}')
    works = []
    digest = Cost.digest

    def counted(cost: Cost, password: str, salt: bytes, length: int) -> bytes:
        works.append((cost, len(salt), length))
        return digest(cost, password, salt, length)

    monkeypatch.setattr(Cost, 'digest', counted)
    for name in ('ada', 'eve'):
        assert users.verify(name, 'wrong password') is None
    assert works == [(QUICK, 16, 32)] * 2
    # where there is nobody, neither
    assert _users(file).verify('ada', PASSWORD) is None
    assert works[-1] == (COST, 16, 32)


def test_comments_and_empty_lines_are_skipped(file: Path) -> None:
    users = _users(file, '# who may', '', '  ', f'ada:operator:{SECRET}\r')
    assert len(users) == 1
    assert users.verify('ada', PASSWORD) is Role.OPERATOR


@pytest.mark.parametrize(('line', 'why'), [
    ('ada', 'it must be name:role'), ('ada:operator', 'it must be name:role'),
    (f'ada:operator:{SECRET}:', 'it must be name:role'),
    (f':operator:{SECRET}', 'a name must have'), (f'a b:operator:{SECRET}', 'a name must have'),
    (f'{"x" * 65}:operator:{SECRET}', 'a name must have'),
    (f'<script>:operator:{SECRET}', 'a name must have'),
    (f'\ufeffada:operator:{SECRET}', 'a name must have'),
    (f'eve:admin:{SECRET}', 'the role must be'), (f'eve:OPERATOR:{SECRET}', 'the role must be'),
    (f'eve:root$:{SECRET}', 'the role must be'),
    (f'bob:operator:{SECRET}', "there is a user 'bob' already"),
    ('eve:viewer:hunter22', 'must be scrypt'), ('eve:viewer:', 'must be scrypt'),
    (f'eve:viewer:md5$4$1$1${SALT}${DIGEST}', 'must be scrypt'),
    (f'eve:viewer:scrypt$4$1$1${SALT}', 'must be scrypt'),
    (f'eve:viewer:scrypt$4$1$1${SALT}${DIGEST}$', 'must be scrypt'),
    (f'eve:viewer:scrypt$4$-1$1${SALT}${DIGEST}', 'must be numbers'),
    (f'eve:viewer:scrypt$٤$1$1${SALT}${DIGEST}', 'must be numbers'),
    (f'eve:viewer:scrypt$1e3$1$1${SALT}${DIGEST}', 'must be numbers'),
    (f'eve:viewer:scrypt${"9" * 5000}$1$1${SALT}${DIGEST}', 'must be numbers'),
    (f'eve:viewer:scrypt$5$1$1${SALT}${DIGEST}', 'power of 2'),
    (f'eve:viewer:scrypt$0$1$1${SALT}${DIGEST}', 'power of 2'),
    (f'eve:viewer:scrypt$4$0$1${SALT}${DIGEST}', 'r = 0 at least 1'),
    (f'eve:viewer:scrypt$4$1$17${SALT}${DIGEST}', 'p = 17 from 1 to 16'),
    (f'eve:viewer:scrypt$536870912$8$1${SALT}${DIGEST}', 'more than 256 MiB'),
    (f'eve:viewer:scrypt$4$999999999$1${SALT}${DIGEST}', 'more than 256 MiB'),
    (f'eve:viewer:scrypt$65536$1$1${SALT}${DIGEST}', r'below 2\^\(16 r\)'),
    (f'eve:viewer:scrypt$4$1$1$*${DIGEST}', 'base64'),
    (f'eve:viewer:scrypt$4$1$1$AAA${DIGEST}', 'base64'),
    (f'eve:viewer:scrypt$4$1$1$ä${DIGEST}', 'ASCII'),
    (f'eve:viewer:scrypt$4$1$1$${DIGEST}', '8 to 64 bytes'),
    (f'eve:viewer:scrypt$4$1$1${SALT}$AAAA', '16 to 64')])
def test_a_bad_line_is_named_and_not_quoted(file: Path, line: str, why: str) -> None:
    with pytest.raises(ValueError, match=why) as caught:
        _users(file, '# users', f'bob:operator:{SECRET}', line)
    assert f'{file}, line 3: ' in str(caught.value)
    assert 'hunter22' not in str(caught.value)
    assert DIGEST not in str(caught.value)


def test_bytes_that_are_no_text_are_named(file: Path) -> None:
    with pytest.raises(ValueError, match='line 2: it is not UTF-8'):
        Users.read(_write(file, b'# users\n\xff\n'))


@pytest.mark.parametrize('mode', [0o620, 0o602, 0o666, 0o777])
def test_a_file_that_others_can_write_is_refused(file: Path, mode: int) -> None:
    _write(file, f'ada:operator:{SECRET}\n', mode)
    with pytest.raises(ValueError, match=f'its mode is 0{mode:o}: chmod 600'):
        Users.read(file)


@pytest.mark.parametrize('mode', [0o600, 0o400, 0o640, 0o644])
def test_a_file_that_others_can_read_is_not(file: Path, mode: int) -> None:
    assert len(Users.read(_write(file, f'ada:operator:{SECRET}\n', mode))) == 1


@pytest.mark.parametrize('kind', ['folder', 'pipe', 'device', 'missing'])
def test_what_is_no_file_is_refused_at_once(file: Path, kind: str) -> None:
    if kind == 'folder':
        file.mkdir(mode=0o700)
    elif kind == 'pipe':
        os.mkfifo(file, 0o600)
    elif kind == 'device':
        file = Path('/dev/zero')
    with pytest.raises(OSError if kind == 'missing' else ValueError,
                       match='users' if kind == 'missing' else 'is not a regular file'):
        Users.read(file)


def test_a_file_has_bounds(file: Path) -> None:
    with pytest.raises(ValueError, match='more than 262144 bytes'):
        Users.read(_write(file, '#' * 300_000))
    with pytest.raises(ValueError, match='line 1001: there are more than 1000 users'):
        _users(file, *(f'user{number}:viewer:{SECRET}' for number in range(1001)))


@pytest.fixture
def throttle(clock: Clock) -> Throttle:
    return Throttle(clock)


def _waits(throttle: Throttle, clock: Clock, count: int, address: str, name: str) -> list[float]:
    """Try again as soon as one may, and list how long that was each time."""
    waits = []
    for _ in range(count):
        wait = throttle.attempt(address, name)
        waits.append(wait)
        if wait:
            clock.now += wait
            assert throttle.attempt(address, name) == 0.0
    return waits


def test_five_may_be_wrong_and_then_the_wait_grows(throttle: Throttle, clock: Clock) -> None:
    assert _waits(throttle, clock, 13, '10.0.0.1', 'ada') == [
        0, 0, 0, 0, 0, 10, 20, 40, 80, 160, 300, 300, 300]


def test_one_who_waits_may_ask_without_waiting_longer(throttle: Throttle, clock: Clock) -> None:
    for _ in range(5):
        throttle.attempt('10.0.0.1', 'ada')
    for _ in range(100):
        assert throttle.attempt('10.0.0.1', 'ada') == 10.0
    clock.now += 4.0
    assert throttle.attempt('10.0.0.1', 'ada') == 6.0


def test_slow_ones_never_wait(throttle: Throttle, clock: Clock) -> None:
    for _ in range(100):
        assert throttle.attempt('10.0.0.1', 'ada') == 0.0
        clock.now += 15.1


def test_after_a_long_while_it_begins_anew(throttle: Throttle, clock: Clock) -> None:
    _waits(throttle, clock, 10, '10.0.0.1', 'ada')
    clock.now += 2 * 300.0 + 1.0
    assert _waits(throttle, clock, 6, '10.0.0.1', 'ada') == [0, 0, 0, 0, 0, 10]


def test_an_address_has_four_times_as_many_attempts_with_any_names(throttle: Throttle) -> None:
    for number in range(20):
        assert throttle.attempt('10.0.0.1', f'name{number}') == 0.0
    assert throttle.attempt('10.0.0.1', 'another') == 10.0
    assert throttle.attempt('10.0.0.2', 'another') == 0.0


def test_a_stranger_at_another_address_cannot_lock_out_an_operator(
        throttle: Throttle, clock: Clock) -> None:
    for _ in range(3):
        for number in range(200):
            throttle.attempt(f'10.0.1.{number}', 'ada')
        assert throttle.attempt('10.0.0.1', 'ada') == 0.0
        clock.now += 20.0
    assert throttle.attempt('10.0.0.1', 'bob') == 0.0


def test_an_address_with_wrong_log_ins_of_one_name_does_not_keep_out_another_name(
        throttle: Throttle) -> None:
    for _ in range(20):
        throttle.attempt('10.0.0.1', 'ada')
    assert throttle.attempt('10.0.0.1', 'bob') == 0.0


@pytest.mark.parametrize(('addresses', 'together'), [
    (['2001:db8::1', '2001:db8::2', '2001:db8:0:0:ffff::3'], True),
    (['2001:db8::1', '2001:db8:0:1::1'], False), (['10.0.0.1', '::ffff:10.0.0.1'], True),
    (['fe80::1%eth0', 'fe80::2%eth0'], True), (['nonsense', 'nonsense2'], False)])
def test_addresses_of_one_network_count_together(
        throttle: Throttle, addresses: list[str], together: bool) -> None:
    for _ in range(5):
        assert throttle.attempt(addresses[0], 'b') == 0.0
    for address in addresses[1:]:
        assert (throttle.attempt(address, 'b') > 0.0) is together


def test_a_right_password_frees_the_name(throttle: Throttle, clock: Clock) -> None:
    for _ in range(20):
        assert throttle.attempt('10.0.0.1', 'ada') == 0.0
        throttle.succeeded('10.0.0.1', 'ada')
    for _ in range(4):
        throttle.attempt('10.0.1.9', 'bob')
    assert throttle.attempt('10.0.1.9', 'bob') == 0.0
    throttle.succeeded('10.0.1.9', 'bob')
    assert throttle.attempt('10.0.1.9', 'bob') == 0.0


def test_an_account_of_ones_own_does_not_free_the_address(
        throttle: Throttle, clock: Clock) -> None:
    tried = 0
    for second in range(3600):
        clock.now += 1.0
        # log in rightly as soon as one may, and guess at others then
        if throttle.attempt('10.0.0.1', 'mallory') == 0.0:
            throttle.succeeded('10.0.0.1', 'mallory')
            tried += throttle.attempt('10.0.0.1', f'victim{second}') == 0.0
    assert tried <= 40


def test_others_do_not_lock_out_who_was_here_before(throttle: Throttle, clock: Clock) -> None:
    throttle.attempt('10.0.0.1', 'ada')
    throttle.succeeded('10.0.0.1', 'ada')
    for number in range(50):
        throttle.attempt('10.0.0.1', f'name{number}')
    assert throttle.attempt('10.0.0.1', 'bob') > 0.0
    assert throttle.attempt('10.0.0.1', 'ada') == 0.0
    # but attempts with the name count
    for _ in range(4):
        throttle.attempt('10.0.0.1', 'ada')
    assert throttle.attempt('10.0.0.1', 'ada') > 0.0


def test_what_is_remembered_of_strangers_is_bounded(
        throttle: Throttle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, '_MAX_KEYS', 100)
    for number in range(1000):
        throttle.attempt(f'10.0.{number // 250}.{number % 250}', f'{number}' + 'x' * 100_000)
        throttle.succeeded(f'10.0.{number // 250}.{number % 250}', f'{number}' + 'x' * 100_000)
        throttle.attempt('not an address' + 'x' * 100_000 + str(number), '\ud800')
    assert len(throttle._attempts) <= 100
    assert len(throttle._known) <= 100
    assert max(len(part) for key in throttle._attempts for part in key) <= 256


def test_none_gets_through_while_others_are_checked(throttle: Throttle) -> None:
    let, start = [], threading.Barrier(20)

    def attempt() -> None:
        start.wait()
        let.append(throttle.attempt('10.0.0.1', 'ada') == 0.0)

    threads = [threading.Thread(target=attempt) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(let) == 5


@pytest.fixture
def sessions(clock: Clock) -> Sessions:
    return Sessions(clock)


def test_a_session_is_found_by_its_token(sessions: Sessions) -> None:
    token, other = sessions.open('ada', Role.OPERATOR), sessions.open('bob', Role.VIEWER)
    assert token != other
    assert len(token) >= 43
    found = sessions.find(token)
    assert found is not None
    assert (found.name, found.role) == ('ada', Role.OPERATOR)
    # and the token itself is held nowhere
    assert token not in repr(sessions._held)


@pytest.mark.parametrize('token', [None, '', 'x', 'x' * 43, '\ud800', '\0', 'x' * 10_000])
def test_any_other_token_finds_nothing(sessions: Sessions, token: str | None) -> None:
    sessions.open('ada', Role.OPERATOR)
    assert sessions.find(token) is None
    sessions.close(token)
    assert len(sessions) == 1


def test_a_session_ends_when_it_is_not_used(sessions: Sessions, clock: Clock) -> None:
    token = sessions.open('ada', Role.OPERATOR)
    for _ in range(5):
        clock.now += 3599.0
        assert sessions.find(token)
    clock.now += 3600.0
    assert sessions.find(token) is None
    assert len(sessions) == 0


def test_a_session_ends_also_when_it_is_used(sessions: Sessions, clock: Clock) -> None:
    token = sessions.open('ada', Role.OPERATOR)
    for _ in range(23):
        clock.now += 1800.0
        assert sessions.find(token)
    clock.now += 1800.0
    assert sessions.find(token) is None


def test_a_page_that_is_only_open_is_no_use(sessions: Sessions, clock: Clock) -> None:
    token = sessions.open('ada', Role.OPERATOR)
    clock.now += 3599.0
    assert sessions.find(token, use=False)
    clock.now += 1.0
    assert sessions.find(token, use=False) is None


def test_a_session_is_closed(sessions: Sessions) -> None:
    tokens = [sessions.open('ada', Role.OPERATOR) for _ in range(3)]
    other = sessions.open('bob', Role.VIEWER)
    sessions.close(tokens[0])
    sessions.close(tokens[0])
    assert [sessions.find(token) is None for token in tokens] == [True, False, False]
    sessions.close_all('ada')
    assert not any(sessions.find(token) for token in tokens)
    assert sessions.find(other)


def test_sessions_are_bounded_and_one_user_ends_own_ones_only(
        sessions: Sessions, clock: Clock) -> None:
    other = sessions.open('bob', Role.VIEWER)
    tokens = [sessions.open('ada', Role.OPERATOR) for _ in range(50)]
    assert [bool(sessions.find(token)) for token in tokens] == [False] * 30 + [True] * 20
    assert sessions.find(other)
    used = [sessions.open(f'user{number}', Role.VIEWER) for number in range(979)]
    assert len(sessions) == 1000
    # what was idle for longest goes
    for token in (other, *tokens[31:], *used):
        assert sessions.find(token)
    sessions.open('one more', Role.VIEWER)
    assert len(sessions) == 1000
    assert sessions.find(tokens[30]) is None
    assert sessions.find(other)
    clock.now += 3600.0
    sessions.open('later', Role.VIEWER)
    assert len(sessions) == 1


@pytest.mark.parametrize(('origin', 'host', 'scheme', 'same'), [
    ('http://127.0.0.1:8080', '127.0.0.1:8080', 'http', True),
    ('https://panel.plant', 'panel.plant', 'https', True),
    ('https://panel.plant:443', 'panel.plant', 'https', True),
    ('http://panel.plant', 'panel.plant:80', 'http', True),
    ('HTTP://Panel.Plant:8080', 'panel.plant:8080', 'http', True),
    ('http://[::1]:8080', '[::1]:8080', 'http', True),
    (None, '127.0.0.1:8080', 'http', False), ('null', '127.0.0.1:8080', 'http', False),
    ('', '', 'http', False), ('http://', '', 'http', False),
    ('http://evil.example', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1:8081', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1', '127.0.0.1:8080', 'http', False),
    ('https://127.0.0.1:8080', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1:8080', '127.0.0.1:8080', 'https', False),
    ('http://127.0.0.1:8080.evil.example', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1:8080@evil.example', '127.0.0.1:8080', 'http', False),
    ('http://evil.example@127.0.0.1:8080', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1:8080/', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1:8080?', '127.0.0.1:8080', 'http', False),
    ('http://127.0.0.1:8080\n', '127.0.0.1:8080', 'http', False),
    (' http://127.0.0.1:8080', '127.0.0.1:8080', 'http', False),
    ('http://localhost:8080', '127.0.0.1:8080', 'http', False),
    ('http://panel.plant.', 'panel.plant', 'http', False),
    ('http://panel\u212a', 'panelk', 'http', False),
    ('http://x:123456', 'x:123456', 'http', False),
    ('http://' + 'x' * 1000, 'x' * 1000, 'http', False),
    ('file://x', 'x', 'file', False), ('ftp://x', 'x', 'ftp', False),
    ('http://x, http://y', 'x', 'http', False)])
def test_origins(origin: str | None, host: str, scheme: str, same: bool) -> None:
    assert same_origin(origin, host, scheme) is same


@pytest.mark.parametrize(('host', 'loopback'), [
    ('127.0.0.1', True), ('127.8.9.1', True), ('localhost', True), ('LocalHost', True),
    ('::1', True), ('[::1]', True), ('::ffff:127.0.0.1', True), ('0.0.0.0', False), ('::', False),
    ('', False), ('[]', False), ('[', False), ('10.0.0.1', False), ('::ffff:10.0.0.1', False),
    ('127.1', False), ('127.0.0.1.evil.example', False), ('localhost.evil.example', False),
    ('127.0.0.1 ', False), ('0x7f000001', False), ('panel.plant', False), ('ä', False)])
def test_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(('host', 'without', 'having'), [
    ('127.0.0.1:8080', True, True), ('localhost', True, True), ('[::1]:8080', True, True),
    ('evil.example:8080', False, True), ('localhost.evil.example', False, True),
    ('', False, False), ('localhost@evil.example', False, False), ('x' * 1000, False, False)])
def test_without_passwords_only_names_of_the_loopback_are_answered(
        file: Path, host: str, without: bool, having: bool) -> None:
    assert may_be_addressed(host, None) is without
    assert may_be_addressed(host, _users(file)) is without
    assert may_be_addressed(host, _users(file, f'ada:viewer:{SECRET}')) is having


def test_only_the_loopback_needs_no_password(file: Path) -> None:
    some, none = _users(file, f'ada:viewer:{SECRET}'), _users(file)
    for host in ('127.0.0.1', '::1', 'localhost'):
        for users in (some, none, None):
            assert needs_password(host, users) == ''
    for host in ('0.0.0.0', '::', '10.0.0.1', 'panel.plant', ''):
        assert needs_password(host, some) == ''
        for users in (none, None):
            assert needs_password(host, users).startswith(
                f'the panel is not served on {host!r} without passwords: name a file of users')


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Return what is typed at the questions for a password, hashed quickly."""
    answers: list[str] = []
    monkeypatch.setattr(getpass, 'getpass', lambda prompt: answers.pop(0))
    monkeypatch.setattr(access, 'hashed', lambda password: hashed(password, QUICK))
    yield answers
    assert not answers


def test_the_command_writes_users(file: Path, typed: list[str]) -> None:
    for name, password, role in [
            ('ada', PASSWORD, 'operator'), ('bob', 'battery staple', 'viewer'),
            ('ada', 'another one', 'viewer')]:
        typed += [password, password]
        assert main([str(file), name, role]) == 0
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
    users = Users.read(file)
    assert users.verify('ada', PASSWORD) is None
    assert users.verify('ada', 'another one') is Role.VIEWER
    assert users.verify('bob', 'battery staple') is Role.VIEWER
    assert [line.split(':')[0] for line in file.read_text().splitlines()] == ['ada', 'bob']
    assert os.listdir(file.parent) == ['users']


def test_other_lines_links_and_comments_stay(file: Path) -> None:
    _write(file, f'# who may\n\nada:operator:{SECRET}\n# and\nbob:viewer:{SECRET}\n\n', 0o644)
    link = file.with_name('link')
    link.symlink_to(file)
    other = hashed('another one', QUICK)
    write_user(link, 'ada', Role.VIEWER, other)
    assert link.is_symlink()
    assert file.read_text() == (
        f'# who may\n\nada:viewer:{other}\n# and\nbob:viewer:{SECRET}\n')
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    write_user(file, 'eve', Role.VIEWER, other)
    assert file.read_text().endswith(f'bob:viewer:{SECRET}\neve:viewer:{other}\n')


@pytest.mark.parametrize('text', ['', '\n', '\n\n'])
def test_an_empty_file_gets_its_first_line(file: Path, text: str) -> None:
    write_user(_write(file, text), 'ada', Role.VIEWER, SECRET)
    assert file.read_text() == f'ada:viewer:{SECRET}\n'


@pytest.mark.parametrize(('name', 'answers', 'why'), [
    ('ada', [PASSWORD, 'correct hors'], 'the two passwords differ: nothing was written'),
    ('ada', ['short', 'short'], 'a password must have 8'),
    ('a:b', [], 'a name must have'), ('', [], 'a name must have'),
    ('a\nb', [], 'a name must have')])
def test_the_command_refuses(file: Path, typed: list[str], name: str, answers: list[str], why: str,
                             capsys: pytest.CaptureFixture[str]) -> None:
    typed += answers
    assert main([str(file), name, 'viewer']) == 1
    assert why in capsys.readouterr().err
    assert not file.exists()


@pytest.mark.parametrize(('text', 'mode'), [('nonsense\n', 0o600), ('', 0o666)])
def test_the_command_leaves_a_file_that_is_not_to_be_trusted(
        file: Path, typed: list[str], text: str, mode: int,
        capsys: pytest.CaptureFixture[str]) -> None:
    _write(file, text, mode)
    assert main([str(file), 'ada', 'viewer']) == 1
    assert str(file) in capsys.readouterr().err
    assert file.read_text() == text


@pytest.mark.parametrize('error', [KeyboardInterrupt, EOFError])
def test_the_command_may_be_given_up(file: Path, error: type[BaseException],
                                     monkeypatch: pytest.MonkeyPatch) -> None:
    def give_up(prompt: str) -> str:
        raise error

    monkeypatch.setattr(getpass, 'getpass', give_up)
    assert main([str(file), 'ada', 'viewer']) == 1
    assert not file.exists()


@pytest.mark.parametrize('secret', [
    'plain', SECRET + '\nmallory:operator:' + SECRET, SECRET + '\n'])
def test_what_is_no_hash_is_not_written(file: Path, secret: str) -> None:
    with pytest.raises(ValueError):
        write_user(file, 'ada', Role.VIEWER, secret)
    assert not file.exists()


def test_a_write_that_fails_leaves_the_old_file(
        file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = f'ada:operator:{SECRET}\n'
    _write(file, text)

    def fail(*arguments: object) -> None:
        raise OSError('no space')

    monkeypatch.setattr(os, 'replace', fail)
    with pytest.raises(OSError, match='no space'):
        write_user(file, 'ada', Role.VIEWER, SECRET)
    assert file.read_text() == text
    assert os.listdir(file.parent) == ['users']


def test_the_module_is_a_command_that_explains_itself() -> None:
    done = subprocess.run([sys.executable, '-m', 'koopman_ros.panel.access', '--help'],
                          capture_output=True, text=True, timeout=30, check=True)
    assert 'FILE NAME ROLE' in done.stdout
