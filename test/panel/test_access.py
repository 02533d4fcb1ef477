# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Users: passwords, the file of users, and the command that writes it."""

import getpass
import os
from pathlib import Path
import stat

from argon2 import PasswordHasher
import pytest

from koopman_ros.panel import access
from koopman_ros.panel.access import hashed, main, Users, write_user
from koopman_ros.panel.requests import Role

PASSWORD = 'correct horse'
# hashes that are quick to verify, the same in all processes
_QUICK = PasswordHasher(1, 8, 1)
SECRET = _QUICK.hash(PASSWORD, salt=b'salt of a test')
OTHER = _QUICK.hash('battery staple', salt=b'salt of a test')


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hash at a low cost."""
    monkeypatch.setattr(access, '_HASHER', _QUICK)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / 'users'


def _write(file: Path, text: str | bytes, mode: int = 0o600) -> Path:
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    file.chmod(mode)
    return file


def _users(file: Path, *lines: str) -> Users:
    return Users.read(_write(file, ''.join(f'{line}\n' for line in lines)))


def test_a_hash_is_argon2id_at_its_recommended_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    secret = hashed(PASSWORD)
    assert secret.startswith('$argon2id$v=19$m=65536,t=3,p=4$')
    assert PASSWORD not in secret
    assert secret != hashed(PASSWORD)


@pytest.mark.parametrize('password', ['', '1234567', 'x' * 1025])
def test_the_length_of_a_password_is_bounded(password: str) -> None:
    with pytest.raises(ValueError, match='8 to 1024 characters'):
        hashed(password)


@pytest.mark.parametrize(('name', 'password', 'role'), [
    ('ada', PASSWORD, Role.OPERATOR), ('bob', PASSWORD, Role.VIEWER),
    # the same characters in another form
    ('Ju\u0308rgen', 'Schlu\u0308ssel', Role.VIEWER),
    ('ada', 'correct hors', None), ('ada', PASSWORD + ' ', None), ('ada', '', None),
    ('eve', PASSWORD, None), ('', PASSWORD, None), ('ada:operator', PASSWORD, None),
    ('Ada', PASSWORD, None), ('ada\0', PASSWORD, None), ('ada', PASSWORD + '\0', None),
    ('\ud800', '\ud800' * 10, None), ('ada', 'x' * 10_000_000, None),
    ('x' * 10_000_000, PASSWORD, None)])
def test_only_the_right_password_has_a_role(
        file: Path, name: str, password: str, role: Role | None) -> None:
    users = _users(file, f'ada:operator:{SECRET}', f'bob:viewer:{hashed(PASSWORD)}',
                   f'Jürgen:viewer:{hashed("Schlüssel")}')
    assert users.verify(name, password) is role


def test_an_unknown_name_is_verified_as_well(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    users, verified = _users(file, f'ada:operator:{SECRET}'), []

    class Counting:
        def verify(self, secret: str, password: str) -> bool:
            verified.append(password)
            return _QUICK.verify(secret, password)

    monkeypatch.setattr(access, '_HASHER', Counting())
    for name in ('ada', 'eve'):
        assert users.verify(name, 'wrong password') is None
    assert verified == ['wrong password'] * 2


@pytest.mark.parametrize(('line', 'words'), [
    ('ada', 'role must be'), (f':operator:{SECRET}', 'a name must have'),
    (f'a b:operator:{SECRET}', 'a name must have'),
    (f'{"x" * 65}:operator:{SECRET}', 'a name must have'),
    (f'<script>:operator:{SECRET}', 'a name must have'),
    (f'eve:admin:{SECRET}', 'role must be'), (f'bob:operator:{SECRET}', "'bob' already exists"),
    ('eve:viewer:hunter22', 'hash of argon2'), ('eve:viewer:scrypt$4$1$1$x$y', 'hash of argon2'),
    (f'eve:viewer:{SECRET}'.replace('m=8', 'm=1073741824'), 'of memory')])
def test_a_wrong_line_is_named_and_not_quoted(file: Path, line: str, words: str) -> None:
    with pytest.raises(ValueError, match=f'users, line 3: .*{words}') as error:
        _users(file, '# users', f'bob:viewer:{SECRET}', line)
    assert 'hunter22' not in str(error.value)
    assert SECRET not in str(error.value)


@pytest.mark.parametrize(('content', 'mode', 'words'), [
    ('', 0o620, 'writable by others'), ('', 0o602, 'writable by others'),
    (b'\xff', 0o600, "can't decode"), ('#' * 300_000, 0o600, 'more than')])
def test_a_file_that_cannot_be_trusted_is_rejected(
        file: Path, content: str | bytes, mode: int, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Users.read(_write(file, content, mode))


@pytest.mark.parametrize('kind', ['pipe', 'folder', 'device'])
def test_another_kind_of_file_is_rejected_at_once(file: Path, kind: str) -> None:
    if kind == 'pipe':
        os.mkfifo(file)
    elif kind == 'folder':
        file.mkdir()
    else:
        file.symlink_to('/dev/zero')
    with pytest.raises(ValueError, match='not a regular file'):
        Users.read(file)


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the answers to the questions for a password."""
    answers: list[str] = []
    monkeypatch.setattr(getpass, 'getpass', lambda prompt: answers.pop(0))
    return answers


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
    assert len(users) == 2
    assert os.listdir(file.parent) == ['users']


def test_other_lines_and_links_stay(file: Path) -> None:
    _write(file, f'# who may\n\nada:operator:{SECRET}\n# and\nbob:viewer:{SECRET}\n', 0o644)
    link = file.with_name('link')
    link.symlink_to(file)
    write_user(link, 'ada', Role.VIEWER, OTHER)
    assert link.is_symlink()
    assert file.read_text() == (
        f'# who may\n\n# and\nbob:viewer:{SECRET}\nada:viewer:{OTHER}\n')
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize(('name', 'answers', 'text', 'mode', 'words'), [
    ('ada', [PASSWORD, 'correct hors'], None, 0, 'the two passwords differ'),
    ('ada', ['short', 'short'], None, 0, '8 to 1024 characters'),
    ('a:b', [], None, 0, 'a name must have'), ('', [], None, 0, 'a name must have'),
    ('a\nb', [], None, 0, 'a name must have'),
    ('ada', [], 'nonsense\n', 0o600, 'line 1'), ('ada', [], '', 0o666, 'writable by others')])
def test_the_command_rejects_and_writes_nothing(
        file: Path, typed: list[str], name: str, answers: list[str], text: str | None, mode: int,
        words: str, capsys: pytest.CaptureFixture[str]) -> None:
    if text is not None:
        _write(file, text, mode)
    typed += answers
    assert main([str(file), name, 'viewer']) == 1
    assert words in capsys.readouterr().err
    assert (file.read_text() if file.exists() else None) == text
    assert not typed


@pytest.mark.parametrize('error', [KeyboardInterrupt, EOFError])
def test_the_command_may_be_cancelled(file: Path, error: type[BaseException],
                                      monkeypatch: pytest.MonkeyPatch) -> None:
    def cancel(prompt: str) -> str:
        raise error

    monkeypatch.setattr(getpass, 'getpass', cancel)
    assert main([str(file), 'ada', 'viewer']) == 1
    assert not file.exists()


@pytest.mark.parametrize('secret', ['plain', SECRET + '\nmallory:operator:' + SECRET + 'x'])
def test_only_a_hash_is_written(file: Path, secret: str) -> None:
    with pytest.raises(ValueError, match=r'must (not contain spaces|be a hash)'):
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
        write_user(file, 'ada', Role.VIEWER, OTHER)
    assert file.read_text() == text
    assert os.listdir(file.parent) == ['users']
