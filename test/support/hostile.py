# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A loop all of whose texts are markup and code, as a source of the panel's pages."""

from concurrent.futures import Future
from dataclasses import replace
import math

from koopman_ros.panel.alarms import Priority
from koopman_ros.panel.requests import Action, Answer
from koopman_ros.panel.snapshot import CONTROLLER, ERROR, Snapshot, TRAINER
from koopman_ros.panel.training_report import Learning, ReplayComparison, TrainingReport
from koopman_ros.panel.view_model import LoopViewModel
from koopman_ros.parameters.description import ParameterDescription
from koopman_ros.parameters.signal_topics import Signals

NOW = 1_790_000_000.0  # s of Unix time
CODE = 'window.CAUGHT=1'
#: ways out of an attribute, of props, of markup, of a template and of an address
TEXTS = (f'x" :zz="({CODE})" q="', f"x' :zz='({CODE})' q='", f':zz=({CODE})', f':zz={CODE} a',
         f'<img src=x onerror="{CODE}">', f'</script><script>{CODE}</script>',
         f'{{{{constructor.constructor("{CODE}")()}}}}', f'${{{CODE}}}', f'`+({CODE})+`',
         f'javascript:{CODE}', f'{{a|<b onmouseover={CODE}>}}', f"' + ({CODE}) + '")
TEXT = ' '.join(TEXTS)
_PICTURE = b'\x89PNG\r\n\x1a\n'


class HostileSource:
    """Text from everybody: model files, nodes, trainings, operators; `asked` holds the actions."""

    def __init__(self) -> None:
        unit = TEXTS[0]
        signals = Signals({'level': unit, 'height': TEXTS[4]}, {'pump': TEXTS[10]}, ('level',))
        own = self.view = LoopViewModel(signals, signals.units, 3600.0, NOW)
        own.take_model({'level': (0.0, 1.0), 'pump': (0.0, 10.0)}, {TEXT: TEXT, 'kind': TEXT})
        for second in range(20):
            at = NOW - 20.0 + second
            own.take_signals('measured', {'level': 0.5 + second / 50.0, 'height': 1.0}, at, at)
            own.take_signals('commands', {'pump': 2.0 + second}, at, at)
        own.take_record('measurement', {'mode': TEXT, 'level': TEXT}, NOW)
        own.take_record('mode', {'mode': TEXT}, NOW)
        own.take_record('model', {'model': {'name': f'{TEXT}.safetensors', 'digest': TEXT}}, NOW)
        own.take_record('parameters', {'parameters': dict.fromkeys(TEXTS, 1.0)}, NOW)
        own.take_internals({f'estimated_other [{TEXT}]': 1.0})
        task = {TEXT: TEXT, 'model': TEXT, 'law': TEXT, 'model_file': TEXT, 'accepted': 'True',
                f'{TEXT} outside training box [half-ranges]': TEXT, 'reason': TEXT,
                'done [%]': TEXT}
        for name in ('controller: control', 'trainer: training', 'trainer: recording',
                     'trainer: experiment', *TEXTS):
            own.conditions.take_status(name, ERROR, TEXT, task, NOW, plant=TEXT)
        parameters = {name: ParameterDescription(
            name, value, TEXT, TEXT, TEXT, -math.inf, math.inf, read_only, TEXTS)
                      for name, value, read_only in (
                          *((text, 1.0, False) for text in TEXTS),
                          *((f'group {text}.{text}', TEXT, True) for text in TEXTS),
                          ('model', TEXT, False), ('experiment_signal', TEXT, False),
                          *((f'experiment_{end}', TEXT, True) for end in (
                              'length', 'min_hold_time', 'max_hold_time')),
                          (f'{TEXTS[0]}.experiment_min', TEXT, True),
                          (f'{TEXTS[0]}.experiment_max', TEXT, True))}
        for node in (CONTROLLER, TRAINER):
            own.take_parameters(node, parameters)
        for text in TEXTS:
            own.alarms.report(text, True, Priority.HIGH, text, NOW)
            own.alarms.report(f'shelved {text}', True, Priority.LOW, text, NOW)
        own.alarms.advance(NOW + 2.0)
        own.alarms.acknowledge(TEXTS[0], TEXT, NOW + 2.0)
        own.alarms.shelve(f'shelved {TEXTS[0]}', 600.0, TEXT, NOW + 2.0)
        self.learning = Learning(
            TrainingReport('', TEXTS, TEXT, _PICTURE, NOW, True, TEXT),
            ReplayComparison('', TEXTS, TEXT, _PICTURE, TEXT, NOW))
        self.title = TEXT
        self.snapshot = own.snapshot(NOW + 2.0)
        self.asked: list[Action] = []

    @property
    def snapshot(self) -> Snapshot:
        """A new one each time: a page without new ones counts its connection as lost."""
        return replace(self._snapshot)

    @snapshot.setter
    def snapshot(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    def request(self, action: Action) -> Future[Answer]:
        """Reject what an operator asks for, in words that are no better."""
        self.asked.append(action)
        future: Future[Answer] = Future()
        future.set_result(Answer(False, TEXT))
        return future
