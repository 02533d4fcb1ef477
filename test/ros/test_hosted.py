# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What nodes share in a process of many: failures, the file that names the loops."""

from pathlib import Path

import pytest

from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.ros.host import read_loops
from koopman_ros.ros.hosted import HostContext, HostedNode
from koopman_ros.ros.process import answer


@pytest.mark.parametrize('error', [KeyError('a'), SystemExit(3), GeneratorExit()], ids=repr)
def test_an_error_of_a_callback_is_passed_to_the_host(error: BaseException) -> None:
    failed: list[BaseException] = []

    def act(value: int) -> int:
        if value < 0:
            raise error
        return value

    class Callback:
        hosting = HostContext(1, failed.append)

    guarded = HostedNode.guarded(Callback, act)  # type: ignore[arg-type]
    assert guarded(3) == 3
    assert guarded(-3) is None
    assert failed == [error]


def test_file_of_loops(tmp_path: Path) -> None:
    file = tmp_path / 'loops.txt'
    file.write_text('# the old hall\nline_1/reactor_1\n\n/line_1/reactor_2   # rebuilt\n')
    assert read_loops(file) == ('/line_1/reactor_1', '/line_1/reactor_2')


@pytest.mark.parametrize(('text', 'words'), [
    ('a\nb//c\n', "line 2: 'b//c' is not a namespace"),
    ('a\n2b\n', "line 2: '2b' is not a namespace"),
    ('a\nb\n/a\n', 'line 3: /a is also in line 1'),
    ('# none yet\n', 'lists no loops: write one namespace per line'),
])
def test_file_of_loops_that_cannot_be(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / 'loops.txt'
    file.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_loops(file)
    assert words in str(caught.value)


def test_loops_are_taken_by_the_nodes_that_can_be_many(capsys: pytest.CaptureFixture[str]) -> None:
    given = ['program', '--loops', 'loops.txt', '--ros-args', '-p', 'system:=reactor']
    assert answer('controller', given, hosts=True) is None
    assert answer('trainer', given) == 2
    assert answer('controller', ['program', '--loops'], hosts=True) == 2
    assert capsys.readouterr().err.count("unknown argument '--loops'") == 2
