# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The shipped plot layouts name what the nodes publish."""

import json
import re
import xml.etree.ElementTree as ElementTree

from builtin_interfaces.msg import Time
import numpy as np
from sensor_msgs.msg import JointState

from koopman_ros.control import Controller, Mode, StepReport, Tuning
from koopman_ros.control.laws import Plan
from koopman_ros.control.state import EstimateReport
from koopman_ros.core.paths import config_directory, model_path
from koopman_ros.demo import reactor
from koopman_ros.estimation import Estimate, Innovation
from koopman_ros.model import load
from koopman_ros.parameters.trainer_table import preset_wiring
from koopman_ros.ros import topics
from koopman_ros.ros.controller_messages import active_constraints, internals

# What a layout shows: topics with one value by themselves, and internals by their names.
TEMPERATURES = {reactor.TEMPERATURE, reactor.ACTIVE_SETPOINT, reactor.PREDICTED_TEMPERATURE,
                reactor.COOLANT_SETPOINT, reactor.COOLANT_TEMPERATURE}
INTERNALS = {'disturbance', 'transfer', 'gain', 'growth_per_sample', 'level', 'distance_outside',
             'deviation_temperature', 'innovation_temperature'}
LIMITS = {'at_range_coolant_temperature', 'at_rate_coolant_temperature', 'at_limit_temperature'}
WIRING = preset_wiring('reactor')
assert WIRING is not None
TYPES = {topic: kind for topic, (kind, _) in topics.expected_topics(WIRING).items()}
ONE, NONE = np.ones(1), np.zeros(1)
# by a Kalman filter, which says more than the observer, and a law that plans
MODEL = load(model_path('reactor_nz4'))
ESTIMATE = EstimateReport(Estimate(NONE, NONE, np.eye(2), Innovation(NONE, 1.0, 1)),
                          Controller(MODEL, Tuning.for_model(MODEL)).best.estimator)
PLAN = Plan(np.arange(2.0), np.ones((2, 1)), np.ones((1, 1)), NONE, NONE, NONE)
NAMES = {
    topics.CONTROLLER_INTERNALS: list(internals(WIRING.signals, StepReport(
        Mode.AUTOMATIC, 'mpc', estimate=ESTIMATE), Time(), '').name),
    topics.ACTIVE_CONSTRAINTS: list(active_constraints(WIRING.signals, PLAN, Time(), '').name)}


def published(topic: str, field: str, name: str = '') -> str:
    """Return what a curve shows, after a look at the message that it is taken from."""
    kind = TYPES[topic]
    assert kind.get_fields_and_field_types()[field] in ('double', 'sequence<double>')
    assert (kind is JointState) == bool(name)
    return name.split(' [')[0] or topic


def test_the_plotjuggler_layout_subscribes_to_published_topics() -> None:
    layout = ElementTree.parse(config_directory() / 'plotjuggler.xml').getroot()
    shown = []
    for curve in layout.iter('curve'):
        # PlotJuggler unrolls a JointState as /topic/name/position
        _, topic, *name, field = curve.attrib['name'].split('/')
        assert all(part in NAMES[topic] for part in name)
        shown.append(published(topic, field, *name))
    assert len(shown) == len(set(shown))
    assert set(shown) == TEMPERATURES | INTERNALS | LIMITS

    selected = layout.find('Plugins/plugin/selected_topics')
    assert selected is not None
    assert sorted(selected.attrib['value'].split(';')) == sorted(
        {'/' + curve.attrib['name'].split('/')[1] for curve in layout.iter('curve')})


def test_a_kalman_filter_leaves_the_places_of_the_others() -> None:
    plain = internals(WIRING.signals, StepReport(Mode.AUTOMATIC, 'sdre'), Time(), '').name
    assert NAMES[topics.CONTROLLER_INTERNALS][:len(plain)] == list(plain)


def test_the_foxglove_layout_shows_published_topics() -> None:
    layout = json.loads((config_directory() / 'foxglove_layout.json').read_text())
    shown = []
    for panel in layout['configById'].values():
        for series in panel.get('paths', ()):
            parts = re.fullmatch(r'/(\w+)\.(\w+)(?:\[(\d+)\])?', series['value'])
            assert parts is not None
            topic, field, place = parts.groups()
            name = [] if place is None else [NAMES[topic][int(place)]]
            # nothing but its label says what the number in brackets stands for
            assert name in ([], [series['label']])
            shown.append(published(topic, field, *name))
    assert len(shown) == len(set(shown))
    assert set(shown) == TEMPERATURES | INTERNALS | LIMITS
    assert layout['configById']['DiagnosticSummary!all']['topicToRender'] == topics.DIAGNOSTICS
