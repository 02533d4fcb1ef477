# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Code named by a parameter: whatever it raises or returns is a rejection with a sentence."""

from pathlib import Path
from typing import Any

import pytest

from koopman_ros import plants
from koopman_ros.control.laws import Law
from koopman_ros.core.paths import model_path
from koopman_ros.core.plugins import load_plugin, own_code, plug_in
from koopman_ros.model import load
from koopman_ros.parameters.controller import table_of
from koopman_ros.parameters.plant import PlantTable
from koopman_ros.tuning import Tuning

MODULE = """
import sys
class OneArgument:
    def __init__(self, model): pass
class Exits:
    def __init__(self, *_, **__): sys.exit(3)
class Raises:
    def __init__(self, *_, **__): raise KeyError('bug')
class NoLaw:
    def __init__(self, *_, **__): pass
from koopman_ros.control.laws import Law
from koopman_ros.estimation import Estimator
class HalfLaw(Law): pass
class HalfEstimator(Estimator):
    def predict(self, estimate, u, seconds): pass
def nothing(*_, **__): return None
number = 3
"""
NAMES = ('OneArgument', 'Exits', 'Raises', 'NoLaw', 'HalfLaw', 'HalfEstimator', 'nothing',
         'number', 'missing')
MODULES = {'exits': 'import sys\nsys.exit(3)', 'stops': 'raise GeneratorExit',
           'broken': 'def', 'fails': '1 / 0'}


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'own_plugs.py').write_text(MODULE)
    for name, text in MODULES.items():
        (tmp_path / f'plug_{name}.py').write_text(text)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures('modules')
@pytest.mark.parametrize('name', [*(f'own_plugs:{name}' for name in NAMES), *(
    f'plug_{name}:Law' for name in MODULES), 'json:dumps', 'os:getcwd', 'builtins:dict',
    'no.such:thing', ':x', 'sys:'])
@pytest.mark.parametrize('parameter', ['fallback_order', 'estimator'])
def test_law_or_estimator_that_is_none_is_rejected(parameter: str, name: str) -> None:
    table = table_of(load(model_path('reactor_nz4')))
    reason = table.check(table.snapshot({
        parameter: ('sdre', name) if parameter == 'fallback_order' else name}))
    assert name in reason
    assert parameter in reason


@pytest.mark.usefixtures('modules')
@pytest.mark.parametrize(('parameter', 'value', 'missing'), [
    ('fallback_order', ('own_plugs:HalfLaw',), 'lacks compute'),
    ('estimator', 'own_plugs:HalfEstimator', 'lacks correct, restart')])
def test_a_rejection_names_the_methods_that_a_class_lacks(
        parameter: str, value: object, missing: str) -> None:
    table = table_of(load(model_path('reactor_nz4')))
    assert missing in table.check(table.snapshot({parameter: value}))


@pytest.mark.usefixtures('modules')
@pytest.mark.parametrize('name', ['Exits', 'Raises', 'nothing'])
def test_plant_that_cannot_be_built_is_rejected(name: str) -> None:
    with pytest.raises(ValueError, match=f'the plant {name} '):
        plants.build(plants.plant_class(f'own_plugs:{name}'), {})


@pytest.mark.usefixtures('modules')
def test_system_whose_module_exits_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"'plug_exits:Plant' cannot be loaded \(SystemExit"):
        PlantTable({'system': 'plug_exits:Plant'})


def test_an_interrupt_is_none_of_its_failures(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'plug_interrupted.py').write_text('raise KeyboardInterrupt')
    monkeypatch.syspath_prepend(tmp_path)

    with pytest.raises(KeyboardInterrupt):
        load_plugin('plug_interrupted:x', 'law', {})
    class Interrupted(Law):
        def compute(self, *_: Any) -> Any: ...

        def __init__(self, *_: Any) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        plug_in('a', 'law', {'a': Interrupted}, Law, Tuning())


def test_names_of_code_in_a_value() -> None:
    assert own_code('') == own_code('linear') == own_code(('sdre', 'linear')) == []
    assert own_code(('sdre', 'mine:Law')) == own_code('mine:Law') == ['mine:Law']
