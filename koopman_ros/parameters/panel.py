# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the panel node."""

from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_network
import math
from types import MappingProxyType
from typing import Any

from koopman_ros.core.arrays import Array
from koopman_ros.core.declaration import (
    column,
    NO_LOWER,
    NO_UPPER,
    UNBOUNDED,
    value_column,
)
from koopman_ros.core.units import conversion, display_unit
from koopman_ros.model import LiftedModel
from koopman_ros.parameters.signal_topics import (
    InputPlaces,
    MeasuredPlace,
    plant_defaults,
    Signals,
    SignalTopics,
    StatePlaces,
    system_of,
)
from koopman_ros.parameters.table import parameter, ParameterTable, per_signal
from koopman_ros.parameters.trainer import SignalParameters
from koopman_ros.parameters.trainer_table import trainer_signals


def _shown_unit() -> Any:
    return parameter('', 'Unit shown for this signal; empty: the unit of its parameters.',
                     read_only=True)


@dataclass(frozen=True)
class ShownState(StatePlaces):
    """Topics of a state, and its unit on the pages."""

    shown_unit: str = _shown_unit()


@dataclass(frozen=True)
class ShownInput(InputPlaces):
    """Topics of an input, and its unit on the pages."""

    shown_unit: str = _shown_unit()


@dataclass(frozen=True)
class ShownDisturbance(MeasuredPlace):
    """Topic of a measured disturbance, and its unit on the pages."""

    shown_unit: str = _shown_unit()


@dataclass(frozen=True)
class ProcessLimits:
    """Limits of a measurement, in the unit in which people read it; an infinity for none."""

    high: float = math.inf
    low: float = -math.inf
    deviation: float = math.inf  #: from the set-point, in automatic mode
    deadband: float = 0.0  #: by which a value must be back within its limit
    delay: float = 0.0  #: s of wall time beyond a limit until the alarm


@dataclass(frozen=True, eq=False)
class PanelParameters(SignalParameters):
    """Parameters of the panel."""

    model: str = parameter(
        '', 'Model whose signals are shown if no other parameter names them: name of a bundled '
            'model, or path of a .safetensors file.', read_only=True)
    controller: str = parameter(
        'controller', 'Name of the controller node.', read_only=True)
    trainer: str = parameter(
        'trainer', 'Name of the trainer node.', read_only=True)
    title: str = parameter(
        '', 'Title of all pages of the loop; empty: the namespace and the name of the plant.',
        read_only=True)
    loops: tuple[str, ...] = parameter(
        ('',), 'Namespaces of the loops that are shown, e.g. line_1/reactor_3; an empty name: the '
        'namespace of the panel. Each has a node of the name of the panel, for its parameters; '
        'those of the web server are of the panel itself.', read_only=True)
    host: str = parameter(
        '127.0.0.1', 'Address of the web server. Users are required unless it is a loopback '
                     'address.',
        read_only=True)
    port: int = parameter(
        8080, 'Port of the web server; 0: any free port.', '', 0, 65535, read_only=True)
    users: str = parameter(
        '', 'File of users with roles and hashed passwords; empty: every user of this machine is '
            'an operator.', read_only=True)
    tls_certificate: str = parameter(
        '', 'TLS certificate (PEM file); empty: no encryption.', read_only=True)
    tls_key: str = parameter(
        '', 'Private key of the certificate (PEM file).', read_only=True)
    trusted_proxy: tuple[str, ...] = parameter(
        ('',), 'Addresses or networks of reverse proxies whose X-Forwarded-For and '
        'X-Forwarded-Proto are trusted; an empty name: none. Requires users.', read_only=True)
    alarm_file: str = parameter(
        '', 'File that keeps alarms, shelving and the last 24 hours across restarts; empty: '
            'none.', read_only=True)
    history_file: str = parameter(
        '', 'File (.npz) that keeps trends, events and actions across restarts; empty: none.',
        read_only=True)
    command_timeout: float = parameter(
        5.0, 'Longest time from the press of a control on a page to its arrival here; a later '
             'one is refused.', 's', 1.0, 60.0, read_only=True)
    span: float = parameter(
        28800.0, 'Length of the trends.', 's', 600.0, 604800.0, read_only=True)
    alarm_high: Array = value_column(
        'states', UNBOUNDED, 'Measurement above which an alarm is raised.', none=NO_UPPER)
    alarm_low: Array = value_column(
        'states', -UNBOUNDED, 'Measurement below which an alarm is raised.', none=NO_LOWER)
    alarm_deviation: Array = column(
        'states', UNBOUNDED, 'Distance from the set-point beyond which an alarm is raised in '
                             'automatic mode.', none=NO_UPPER)
    alarm_deadband: Array = column(
        'states', 0.0, 'Distance by which the measurement must be back before its alarm returns.')
    alarm_delay: Array = column(
        'states', 10.0, 'Wall time beyond a limit until the alarm.', 's', 0.0, 3600.0)
    states: Mapping[str, ShownState] = per_signal(ShownState)
    inputs: Mapping[str, ShownInput] = per_signal(ShownInput)
    disturbances: Mapping[str, ShownDisturbance] = per_signal(ShownDisturbance)

    def limits(self, signals: Signals) -> dict[str, ProcessLimits]:
        """Return the limits of alarms of measured states, as people read them, by name."""
        found = {}
        for at, name in enumerate(signals.states):
            shown = conversion(signals.states[name], self.read(signals)[name])
            low, high, per_unit = (float(shown(value)) for value in (
                self.alarm_low[at], self.alarm_high[at], 1.0))
            per_unit -= float(shown(0.0))
            found[name] = ProcessLimits(high, low, per_unit * self.alarm_deviation[at],
                                        per_unit * self.alarm_deadband[at], self.alarm_delay[at])
        return found

    def read(self, signals: Signals) -> dict[str, str]:
        """Return the units in which people read the signals, by name."""
        shown: dict[str, ShownState | ShownInput | ShownDisturbance] = {
            **self.states, **self.inputs, **self.disturbances}
        return {name: shown[name].shown_unit or display_unit(unit)
                for name, unit in signals.units.items()}


def panel_signals(present: LiftedModel | None, given: Mapping[str, Any]) -> Signals:
    """Return the signals of the parameters, of a bundled plant, or of a model."""
    return trainer_signals(present, {**plant_defaults(system_of(given), 'panel'), **given})


def panel_table(present: LiftedModel | None = None,
                given: Mapping[str, Any] = MappingProxyType({})
                ) -> ParameterTable[PanelParameters]:
    """
    Return the parameters of a panel.

    :param present: model of the parameters, or None.
    :param given: known values, of which system and signals are used.
    :raises ConfigurationError: if the signals are unknown.
    """
    system = system_of(given)
    signals = panel_signals(present, given)

    def check(values: PanelParameters) -> str:
        if bool(values.tls_certificate) != bool(values.tls_key):
            return 'tls_certificate and tls_key must be set together: set both, or neither'
        for name in ('controller', 'trainer', 'host'):
            if not getattr(values, name):
                return f"{name} = '' must not be empty"
        for proxy in filter(None, values.trusted_proxy):
            try:
                ip_network(proxy)
            except ValueError as error:
                return (f'trusted_proxy = {proxy!r} must be an address, e.g. 127.0.0.1, or a '
                        f'network, e.g. 10.0.0.0/24: {error}')
        read = values.read(signals)
        for name, unit in signals.units.items():
            try:
                conversion(unit, read[name])
            except ValueError as error:
                return (f'{name}.shown_unit = {read[name]!r} must have the dimension of {unit}: '
                        f'{error}')
        return SignalTopics.of(signals, values).check()

    return ParameterTable(
        PanelParameters, check, signals={'states': signals.states, 'inputs': signals.inputs,
                                         'disturbances': signals.disturbances},
        defaults={**signals.defaults(), **plant_defaults(system, 'panel'), 'system': system})
