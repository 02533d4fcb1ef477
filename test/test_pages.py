# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The pages point to what is there, and name and quote what the sources hold."""

import ast
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from importlib.util import find_spec
import json
from pathlib import Path
import re
import shutil
import subprocess
import textwrap
from typing import Any

from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import Transition
import numpy as np
import pytest
import rclpy
import yaml

from koopman_ros import learn_files
from koopman_ros.control.laws import Plan
from koopman_ros.core.message_fields import KNOWN_TYPES, place
from koopman_ros.model import load
from koopman_ros.parameters.signal_topics import DEFAULT_SYSTEM, KINDS
from koopman_ros.parameters.table import Specification
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.ros import node_descriptions, topics
from koopman_ros.ros.controller_messages import active_constraints
from koopman_ros.testing import isolated_domain
from studies import acceptance, exported_loops, late_reactor
from studies.records.table import table_of as records_table
from support.heater_logs import write_heater_logs
from support.nodes import type_support

__all__ = ['type_support']

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted(ROOT.glob('docs/**/*.md'))]
PARTS = 'koopman_ros|studies|benchmarks|examples|config|docs|test'
MAKEFILE = (ROOT / 'Makefile').read_text()
SYSTEMS = sorted(path.stem for path in ROOT.glob('config/plants/*.yaml'))
each_page = pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))


@each_page
def test_relative_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r'\]\(([^)\s]+)\)', page.read_text()):
        if re.match(r'[a-z]+:', link):
            continue
        target, _, anchor = link.partition('#')
        aim = page.parent / target if target else page
        assert aim.exists(), link
        if anchor:
            assert anchor in _anchors(aim), link


@each_page
def test_commands_are_right_as_they_stand(page: Path, tmp_path: Path) -> None:
    _check_commands(page, tmp_path)


@each_page
def test_python_on_pages_compiles_and_its_imports_exist(page: Path) -> None:
    for block in re.findall(r'^```python\n(.*?)^```', page.read_text(), re.DOTALL | re.MULTILINE):
        for node in ast.walk(ast.parse(textwrap.dedent(block))):
            if isinstance(node, ast.ImportFrom):
                exec(ast.unparse(node), {})


def test_model_of_signals_alone_is_saved_as_the_page_has_it(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r'```python\n(.*?)```',
                          (ROOT / 'docs/explanation/control_levels.md').read_text(), re.DOTALL)
    exec(block, {})
    assert load('signals.safetensors').states.names == ('temperature',)


def test_the_logs_of_the_heater_are_as_the_page_has_them(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
        ) -> None:
    write_heater_logs(tmp_path / 'out' / 'tutorials')
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r'```python\n(.*?)```',
                          (ROOT / 'docs/tutorials/measured_record.md').read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(block, names)
    assert 'cold_day' in capsys.readouterr().out
    first = [names['pd'].read_csv(f'out/tutorials/heater_{day}.csv')['temperature [degC]'][0]
             for day in ('day_1', 'day_2', 'cold_day')]
    assert first == pytest.approx([21.0, 21.0, 17.5], abs=0.6)


@pytest.mark.parametrize('page', sorted(ROOT.glob('docs/results/*.md')),
                         ids=lambda page: page.stem)
def test_tables_of_results_name_their_command_and_summary(page: Path) -> None:
    head, *sections = re.split('^## ', page.read_text(), flags=re.MULTILINE)
    for section in ('', *sections):
        if '\n|' in (section or head):
            assert re.search(r'`make [a-z]', head + section), section
            assert re.search(r'\[`\w+\.json`\]\(\w+\.json\)', head + section), section


STEP = 'set-point −10 K'
DISTURBANCES = {  # names in the summary of the rows on the page
    'UA −20 %; +20 %': ('UA −20 %, in the loop', 'UA +20 %, in the loop'),
    'C_A −10 %; +10 %': ('C_A −10 %, in the loop', 'C_A +10 %, in the loop'),
    'T_i −5 K; +5 K': ('T_i −5 K, in the loop', 'T_i +5 K, in the loop'),
    STEP: (STEP,),
    '…, UA −20 %; +20 % throughout': (
        f'{STEP}, UA −20 % all along', f'{STEP}, UA +20 % all along'),
    '…, coolant lag 5; 10; 20 s': tuple(f'{STEP}, coolant lags by {n} s' for n in (5, 10, 20)),
    '…, lag, measured': tuple(
        f'{STEP}, coolant lags by {n} s, measured' for n in (5, 10, 20)),
    '…, coolant stuck at 298 K or above for 15 min; after it': (
        f'{STEP}, coolant stuck at 298.15 K for 15 min, after its end',),
    '…, stuck, measured': (
        f'{STEP}, coolant stuck at 298.15 K for 15 min, after its end, measured',),
    'sensor +2 K wrong': ('sensor bias +2 K',)}


def test_robustness_has_the_figures_of_its_summary() -> None:
    summary = json.loads((ROOT / 'docs/results/robustness.json').read_text())
    rows = [[cell.strip('*') for cell in row] for row in _rows('results/robustness.md')]

    margins = [row for row in rows if len(row) == 4 and row[0][:1].isdecimal()]
    assert len(margins) == 6
    for label, *cells in margins:
        at = f'coolant_weight={"0.1" if "," in label else "1"}/bandwidth={label.split(",")[0]}/'
        for cell, name in zip(cells, ('gain', 'phase_degrees', 'delay_seconds'), strict=True):
            _agrees(cell, min(place[name] for key, place in summary['margins'].items()
                              if key.startswith(at) and place[name] is not None))

    disturbances = {row[0]: row[1:] for row in rows if row[0] in DISTURBANCES}
    for label, names in DISTURBANCES.items():
        for cell, figure in zip(disturbances[label], (
                'largest_kelvin', 'seconds_to_0.2_kelvin', 'disturbance_kelvin'), strict=True):
            shown = cell.partition(' (')[0].split('; ')
            for one, name in zip(shown * (len(names) // len(shown)), names, strict=True):
                _agrees(one, summary['disturbances'][name][figure])

    late = [row for row in rows if row[0].startswith('late: ')]
    assert len(late) == 4
    for label, *cells in late:
        for cell, plant, name in zip(cells, ('unchanged', 'unchanged', 'UA −20 %'), (
                'largest_kelvin', 'seconds_to_0.2_kelvin', 'largest_kelvin'), strict=True):
            for one, share in zip(cell.split('; '), ('0.7', '1', '1.3'), strict=True):
                found = summary['wrong_dead_time'][
                    f'known {label[6:]}, {share} times as long, {plant}']
                if one == 'runs away':
                    assert found['final_kelvin'] > 10.0
                else:
                    _agrees(one, found[name])

    noise = [row for row in rows if len(row) == 5 and row[0][:1].isdecimal()]
    assert len(noise) == 7
    for label, *cells in noise:
        found = summary['noise'][f'bandwidth={label.split()[0]}']
        for cell, name in zip(cells, ('coolant', 'coolant_change', 'temperature',
                                      'fouled_to_0.2'), strict=True):
            _agrees(cell, found[f'{name}_kelvin'])


def test_table_of_other_controllers_has_the_figures_of_its_summary() -> None:
    plants = json.loads((ROOT / 'docs/results/partly_measured.json').read_text())['plants']
    head, *rows = [row for row in _rows('results/validation.md') if len(row) == 4
                   and re.match('controller$|`(mpc|sdre)`$|do-mpc|LQG', row[0])]
    assert len(rows) == 6
    for row in rows:
        for title, cell in zip(head[1:], row[1:], strict=True):
            plant, unit = re.findall(r'\w+', title)
            found = plants[plant][f'{row[0]}, lift' if '`' in row[0] else row[0]]
            if cell == 'the same':
                cell = rows[-2][row.index(cell)]
            factor = 1e3 if unit == 'mm' else 1.0
            for shown, value in zip(re.split('[;,] ', cell), (
                    found['cost_mean'], found['cost_worst'], factor * found['offset_under_load'],
                    factor * found['farthest_under_load']), strict=True):
                _agrees(shown, value)


def test_table_of_noisy_data_has_the_figures_of_its_summary() -> None:
    found = json.loads((ROOT / 'docs/results/sensors.json').read_text())['sensors']
    rows = [row for row in _rows('results/training.md') if len(row) == 3]
    first = next(i for i, row in enumerate(rows) if 'studies-sensors' in row[0]) + 2
    for row, (part, figure) in zip(rows[first:first + 5], (
            ('noisy', 'rollout_kelvin'), ('noisy', 'input_gain_error'),
            ('noise_free', 'rollout_kelvin'), ('drifted', 'offset_before_kelvin'),
            ('drifted', 'offset_after_kelvin')), strict=True):
        values = found[part][figure]
        for cell, value in zip(row[1:], (np.median(values), max(values)), strict=True):
            _agrees(cell.removesuffix(' K'), float(value))


def test_table_of_measured_records_is_that_of_its_summary() -> None:
    summary = json.loads((ROOT / 'docs/results/records.json').read_text())
    assert records_table(summary) in (ROOT / 'docs/results/records.md').read_text()


def test_table_of_a_late_coolant_is_that_of_its_summary_and_keeps_its_bounds() -> None:
    summary = json.loads((ROOT / 'docs/results/late_reactor.json').read_text())
    assert late_reactor.table_of(summary) in (ROOT / 'docs/results/robustness.md').read_text()
    assert summary['learned_dead_time_seconds'] == pytest.approx(
        late_reactor.RECORD_LATE, abs=late_reactor.RECORD_PERIOD / 2.0)
    for shares in summary['late'].values():
        for found in shares.values():
            # of 10 K
            assert found['overshoot_kelvin'] < 0.7
            assert found['cost'] < 1.05 * summary['least_cost']


def test_page_of_the_acceptance_has_the_figures_of_its_summary_and_its_bound_holds() -> None:
    trainings = json.loads((ROOT / 'docs/results/acceptance.json').read_text())['trainings']
    page = (ROOT / 'docs/results/validation.md').read_text()
    assert all(line in page for line in acceptance.coverage(trainings))
    accepted = [one for one in trainings.values() if one['accepted']]
    covered = sum(one['true_failed'] <= one['bound'] * one['true_loops'] for one in accepted)
    assert covered >= 0.95 * len(accepted) > 100
    assert {key.partition('/')[0] for key in trainings} == set(acceptance.CASES)


def test_page_of_the_c_code_has_the_figures_of_its_summary() -> None:
    summary = json.loads((ROOT / 'docs/results/exported_loops.json').read_text())
    page = ' '.join((ROOT / 'docs/how-to/export.md').read_text().split())
    assert all(row in page for row in exported_loops.size_rows(summary))
    assert exported_loops.agreement_text(summary) in page


@each_page
def test_named_files_are_there(page: Path) -> None:
    for code in _inline_code(page):
        for name in re.findall(rf'(?<![/\w])(?:{PARTS})/[\w./*]*', code):
            assert list(ROOT.glob(name)), name


@each_page
def test_names_with_underscores_are_in_the_sources(page: Path) -> None:
    for code in _inline_code(page):
        if '::' not in code:  # names of C++ are others'
            assert set(re.findall(r'\b[a-z]\w*_\w+\b', code)) <= _words(), code


def test_pages_and_packages_are_listed_and_short() -> None:
    listed = re.findall(r'^[\w/-]+$', (ROOT / 'docs' / 'index.md').read_text(), re.MULTILINE)
    assert {str(page.relative_to(ROOT / 'docs').with_suffix(''))
            for page in ROOT.glob('docs/**/*.md')
            if page.parts[-2] != 'api'} <= {*listed, 'index'}
    text = (ROOT / 'CONTRIBUTING.md').read_text()
    for package in ROOT.glob('koopman_ros/*/__init__.py'):
        assert f' koopman_ros/{package.parent.name}/ ' in text
    readme = (ROOT / 'README.md').read_text()
    assert len(readme.splitlines()) <= 120
    assert len(readme.split()) <= 700
    assert sum(len(page.read_text().split()) for page in ROOT.glob('docs/**/*.md')) < 20_000


def test_continuous_integration_runs_documented_commands() -> None:
    commands = re.findall(r'^make .*$', (ROOT / '.ci' / 'run').read_text(), re.MULTILINE)
    pages = (ROOT / 'README.md').read_text() + (ROOT / 'CONTRIBUTING.md').read_text()
    assert len(commands) > 3
    for command in commands:
        assert re.search(rf'(`|^){command}(`|$)', pages, re.MULTILINE), command


def test_interfaces_list_the_topics_with_their_types_and_the_services() -> None:
    assert [row[:2] for row in _rows('reference/interfaces.md') if '_msgs/' in row[1]
            and '`' not in row[1]
            ] == [[f'`{name}`', f'{kind.__module__.split(".")[0]}/{kind.__name__}']
                  for name, kind in topics.TYPES.items()]
    services = {row[0].strip('`') for row in _rows('reference/interfaces.md')
                if 'std_srvs/' in row[1]}
    text = (ROOT / 'docs' / 'reference/interfaces.md').read_text()
    managed = set(re.findall(r'`(~/\w+_\w+)`', text[text.index('## Lifecycle'):]))
    for name, node in node_descriptions.PROGRAMS.items():
        serves = set(node.serves) - set(node_descriptions.STANDARD_SERVICES)
        own = {service for service in serves if service.replace('~', f'/{name}') in services}
        assert serves - own == (managed & serves), name
        assert not serves - own or managed <= {*node.serves, *node.publishes}, name
        services -= {service.replace('~', f'/{name}') for service in own}
    assert not services


def test_interfaces_list_the_limits_of_a_plan() -> None:
    wiring, none = preset_wiring('reactor'), np.zeros(1)
    assert wiring is not None
    (state,), (given,) = wiring.signals.states, wiring.signals.inputs
    plan = Plan(*3 * (none,), none, none, none)
    names = active_constraints(wiring.signals, plan, Time(), '').name
    assert [row[0].strip('`') for row in _rows('reference/interfaces.md')
            if row[0].startswith('`at_')] == [
        name.replace(given, '<input>').replace(f'_{state} ', '_<state> ') for name in names]


@pytest.mark.parametrize(('system', 'column'), [('reactor', 2), ('two_tanks', 3)])
def test_interfaces_list_where_signals_are(system: str, column: int) -> None:
    wiring = preset_wiring(system)
    assert wiring is not None
    listed = {row[1].strip('`'): re.findall('`(.+?)`', row[column])
              for row in _rows('reference/interfaces.md') if re.match('`<(state|input)>.*topic`',
                                                                      row[1])}
    assert listed == {
        f'<{kind}>.{row.name}': [*filter(None, (
            getattr(places, row.name) for places in of.values()))]
        for kind, of in (('state', wiring.states), ('input', wiring.inputs))
        for row in fields(next(iter(of.values()))) if row.name.endswith('topic')}


def test_interfaces_list_the_message_types() -> None:
    text = (ROOT / 'docs' / 'reference/interfaces.md').read_text()
    for kind in KNOWN_TYPES:
        assert f'`{kind}`' in text
    rows = [row for row in _rows('reference/interfaces.md') if '/msg/' in row[1] and len(row) == 4]
    for units, kind, field, there in rows:
        for unit in units.replace('any other', 'V').split(', '):
            found = place('here', '<signal>', unit)
            assert [kind, field] == [f'`{found.type}`', f'`{found.field}`']
            assert there.replace('that of the signal', unit) == found.unit
    assert len(rows) > 4


def test_interfaces_list_the_parameters_of_each_signal() -> None:
    """Beside its places, with the unit of each."""
    rows = {row[0]: row[1:] for row in _rows('reference/interfaces.md') if 'unit]' in row[1]}
    for node, cells in rows.items():
        table = node_descriptions.tables()[node]
        for cell, kind in zip(cells, ('states', 'inputs'), strict=True):
            (name, unit), = table.signals[kind].items()
            listed = {}
            for names, symbol in re.findall(r'((?:`\w+`,? ?)+)\[(.+?)\]', cell):
                for parameter in re.findall(r'\w+', names):
                    listed[parameter] = symbol.replace('unit²', 'unit^2').replace('unit', unit)
            own = {row.removeprefix(f'{name}.'): about.unit.replace('degC', unit)
                   for row, about in table.rows.items()
                   if row.startswith(f'{name}.') and about.unit}
            assert listed == own, (node, kind)
    assert len(rows) == 3


def test_the_page_of_faults_quotes_real_diagnostics() -> None:
    quotes = [quote for row in _rows('reference/faults.md') if len(row) == 4
              for quote in re.findall('`(.+?)`', row[2])]
    assert len(quotes) > 15
    for quote in quotes:
        for part in quote.split('…'):
            assert any(part.strip(' ;:') in text for text in _texts()), quote


# Programs of others, which do nothing here.
FOREIGN = ('gcc', 'sudo', 'git', 'rosdep', 'colcon', 'pip', 'dask')
ANY = 'any'  # node that has the parameters of all
# In place of a program: notes name and arguments.
STUB = f"""#!/bin/sh
printf '%s\\0' "${{0##*/}}" "$@" >> "$NOTES"; printf '\\n\\0' >> "$NOTES"
case "${{0##*/}} $1" in
  'ros2 pkg') echo {ROOT};;
  'colcon build') mkdir -p install && : > install/setup.bash;;
esac
"""


def _check_commands(page: Path, folder: Path) -> None:
    with isolated_domain():
        for command in _commands(page, folder):
            _check_command(command, folder)


def _commands(page: Path, folder: Path) -> Iterator[list[str]]:
    """Have a shell run the commands of a page in a folder; yield programs with arguments."""
    programs = folder / '.venv' / 'bin'
    programs.mkdir(parents=True)
    for name in (*FOREIGN, 'make', 'ros2', 'koopman_ros', 'python', 'python3'):
        (programs / name).write_text(STUB)
        (programs / name).chmod(0o755)
    for path in ROOT.glob('examples/oven/*.yaml'):
        shutil.copy(path, folder)
    (folder / 'loops.txt').write_text('line_1/reactor_1\nline_1/reactor_2\n')
    blocks = re.findall(r'^```(\w+)\n(.*?)^```', page.read_text(), re.DOTALL | re.MULTILINE)
    for kind, block in blocks:
        # a block that begins with the name of a file is that file
        if found := re.match(r'# ([\w]+\.(?:py|yaml))\b', block):
            (folder / found[1]).write_text(block)
        assert kind != 'bash'
    script = ''.join(block for kind, block in blocks if kind == 'sh')
    spans = [code for code in _inline_code(page) if re.match(
        r'(\w+=\S+ )?(make|python|ros2 topic|ros2 run koopman_ros(?! <)) ', code)]
    # parameters without a node
    spans += [f'ros2 run koopman_ros {ANY} --ros-args {found[1] or "-p "}{found[2]}'
              for code in _inline_code(page)
              if (found := re.fullmatch(r'(-p )?([^ ]+:=[^.<][^<]*)', code))
              and not re.search(r'name:=|module:|-r ', code)]
    notes = folder / 'notes'
    notes.touch()
    done = subprocess.run(
        ['bash', '-eu', '-c', '\n'.join((script, *spans))], cwd=folder, text=True,
        capture_output=True, check=False, timeout=60, env={
            'PATH': f'{programs}:/usr/bin:/bin', 'NOTES': str(notes)})
    assert done.returncode == 0, done.stderr
    for command in notes.read_text().split('\n\0')[:-1]:
        yield command.split('\0')[:-1]


def _check_command(command: list[str], folder: Path) -> None:
    """Check a command against what the sources hold."""
    match command:
        case ['make', *words]:
            for word in words:
                name, variable, _ = word.partition('=')
                assert (f'$({name}' in MAKEFILE if variable
                        else re.search(rf'^{name}:', MAKEFILE, re.MULTILINE)), word
        case ['ros2', 'run', 'koopman_ros', node, *arguments]:
            _check_node(node, arguments, folder)
        case (['ros2', 'param', 'set', node, name, value]
              | ['koopman_ros', 'param', node, name, value]):
            assert (row := _row(node.removeprefix('/'), DEFAULT_SYSTEM, name)), name
            assert not _wrong(row, yaml.safe_load(value)), name
        # without -w one message may be sent before its subscribers are known
        case ['ros2', 'topic', 'pub', '-w', count, '--once', topic, kind, message]:
            assert int(count) > 0
            assert _topics()[topic.removeprefix('/')] == kind
            topics.message_class(kind)(**yaml.safe_load(message))
        case ['koopman_ros', 'pub', topic, message]:
            topics.message_class(_topics()[topic.removeprefix('/')])(**yaml.safe_load(message))
        case ['ros2', 'topic', 'echo', topic] | ['ros2', 'topic', 'echo', '--once', topic, *_] | [
                'koopman_ros', 'echo', topic, '--count', _]:
            assert topic in topics.TYPES or topic.removeprefix('/') in _topics(), topic
        case ['ros2', 'service', 'call', service, kind, *request]:
            assert _services()[service] == kind, service
            topics.message_class(kind).Request(**yaml.safe_load(*request or ['{}']))
        case ['koopman_ros', 'call', service, request]:
            topics.message_class(_services()[service]).Request(**yaml.safe_load(request))
        case ['ros2', 'lifecycle', 'set', node, transition]:
            assert '~/change_state' in node_descriptions.PROGRAMS[node.removeprefix('/')].serves
            assert hasattr(Transition, f'TRANSITION_{transition.upper()}')
        case ['ros2', 'launch', 'koopman_ros', file, *arguments]:
            text = (ROOT / 'examples' / file).read_text()
            for argument in arguments:
                assert f"'{argument.partition(':=')[0]}'" in text, argument
        case ['ros2', 'run', 'plotjuggler', 'plotjuggler', '-l', path]:
            assert Path(path).is_file()
        case ['python', '-m', 'koopman_ros', 'learn', *arguments] if arguments:
            learn_files.command_parser().parse_args(arguments)
        case ['python' | 'python3', '-m', module, *_]:
            assert find_spec(module), module
        case ['python', '-c', code]:
            compile(code, 'page', 'exec')
        case ['python', script, *_]:
            assert (ROOT / script).is_file() or (folder / script).is_file(), script
        case _:
            assert (command[0] in FOREIGN
                    or command[:2] in (['ros2', word] for word in ('pkg', 'bag', 'security'))
                    or command == ['ros2', 'topic', 'info', '-v']), command


def _check_node(program: str, arguments: list[str], folder: Path) -> None:
    """Check a node's parameters as ROS reads them."""
    assert program in (*node_descriptions.PROGRAMS, ANY), program
    namespaces = ['']
    if arguments[:1] == ['--loops']:
        assert node_descriptions.PROGRAMS[program].hosts
        namespaces = (folder / arguments[1]).read_text().split()
        arguments = arguments[2:]
    arguments = [str(folder / one) if one.endswith('.yaml') else one for one in arguments]
    for namespace in namespaces:
        given = _as_ros_reads(program, namespace, arguments)
        # a plug-in declares its own
        plugins = [one.partition(':')[2] for one in given.get('fallback_order', ()) if ':' in one]
        # a file is for all nodes
        readers = (node_descriptions.PROGRAMS if program == ANY or '--params-file' in arguments
                   else (program,))
        for name, value in given.items():
            if name.partition('.')[0] not in ('qos_overrides', *plugins):
                rows = [row for reader in readers if (row := _row(
                    reader, given.get('system', DEFAULT_SYSTEM), name))]
                assert rows, name
                assert not _wrong(rows[0], value), name


def _as_ros_reads(program: str, namespace: str, arguments: list[str]) -> dict[str, Any]:
    """Return the values that rcl gives to a node of a name."""
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node(
            program, namespace=namespace or None, context=context, cli_args=arguments,
            start_parameter_services=False, enable_rosout=False,
            automatically_declare_parameters_from_overrides=True)
        values = {name: parameter.value for name, parameter in node.get_parameters_by_prefix(
            '').items() if name not in ('use_sim_time', 'start_type_description_service')}
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    return values


def _row(program: str, system: str, name: str) -> Specification | None:
    """Return the row of a parameter; of a plant that is not shipped, that of another signal."""
    if system in SYSTEMS:
        return _rows_of(program, system).get(name)
    rows = _rows_of(program, DEFAULT_SYSTEM)
    _, dot, last = name.partition('.')
    return rows.get(name) or next((row for other, row in rows.items()
                                   if dot and other.partition('.')[2] == last), None)


@cache
def _rows_of(program: str, system: str) -> dict[str, Specification]:
    return node_descriptions.tables(system)[program].rows


def _wrong(row: Specification, value: Any) -> str:
    """Return what is wrong with a value, as a node does."""
    kind = type(row.default)
    return ('' if isinstance(value, (list, tuple) if kind is tuple else kind)
            else row.type_error(value)) or row.check(value)


@cache
def _topics() -> dict[str, str]:
    """Return the types of the topics of all shipped plants."""
    places = (place for system in SYSTEMS if (wiring := preset_wiring(system))
              for kind in KINDS for place in getattr(wiring, kind).values())
    return {place.topic: place.type for place in places}


@cache
def _services() -> dict[str, str]:
    """Return the types of the services by the table of the interfaces."""
    return {row[0].strip('`'): row[1].replace('/', '/srv/')
            for row in _rows('reference/interfaces.md') if 'std_srvs/' in row[1]}


def _agrees(cell: str, value: float | None) -> None:
    """Compare a figure with a value, to its last digit."""
    if value is None:
        assert cell.startswith('never'), cell
        return
    mantissa, _, exponent = cell.replace('−', '-').partition('e')
    digits = len(mantissa.partition('.')[2]) - int(exponent or 0)
    assert float(f'{mantissa}e{exponent or 0}') == pytest.approx(value, abs=0.501 * 0.1 ** digits)


def _anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    headings = re.findall(r'^#+ (.+)$', page.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def _inline_code(page: Path) -> list[str]:
    """Return what a page sets in backticks within its lines."""
    text = re.sub(r'^```.*?^```', '', page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r'`([^`]+)`', text)


def _rows(page: str) -> Iterator[list[str]]:
    """Yield the cells of the rows of all tables of a page."""
    for line in (ROOT / 'docs' / page).read_text().splitlines():
        if line.startswith('|'):
            yield [cell.strip() for cell in line.strip('|').split('|')]


@cache
def _words() -> set[str]:
    """Return all words of the sources, and of the configuration."""
    paths = [ROOT / 'Makefile', *(path for part in PARTS.split('|') if part != 'docs'
                                  for path in ROOT.glob(f'{part}/**/*'))]
    wirings = map(preset_wiring, ('reactor', 'two_tanks'))
    of_topics = ' '.join(topic for wiring in wirings if wiring for topic in wiring.topics)
    return {word for path in paths if path.suffix in ('', '.py', '.yaml', '.h') and path.is_file()
            for word in re.findall(r'\w+', f'{path.stem} {path.read_text()}')
            } | set(re.findall(r'\w+', of_topics))


@cache
def _texts() -> list[str]:
    """Return the texts in the sources, what is put into them left out."""
    texts = []
    for path in ROOT.glob('koopman_ros/**/*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                texts.append('\0'.join(str(part.value) for part in node.values
                                       if isinstance(part, ast.Constant)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return texts
