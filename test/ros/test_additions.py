# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What CONTRIBUTING says can be added in one file or row, from a folder outside the package."""

from collections.abc import Iterator
import importlib
from pathlib import Path
import textwrap
from types import ModuleType
from unittest import mock

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState

from koopman_ros.core import message_fields
from koopman_ros.core.units import NANOSECONDS
from koopman_ros.parameters.table import ConfigurationError
from koopman_ros.plants import Process
from koopman_ros.records import BagWriter, message_definition, read_series
from koopman_ros.ros.node import LoopNode
from koopman_ros.testing import Harness

PLANT = """
    import numpy as np
    from koopman_ros.plants import ControlAffineSystem

    def leaking_tank():
        return ControlAffineSystem(
            name='tank', state_names=('level',), state_units=('m',), input_names=('inflow',),
            input_units=('m/s',), time_unit='s', drift=np.negative,
            drift_jacobian=lambda x: -np.ones((*x.shape, 1)), B=np.eye(1),
            nominal_state=np.zeros(1), nominal_input=np.zeros(1))
    """
ROW = """
    from dataclasses import dataclass
    from koopman_ros.parameters.plant import PlantParameters
    from koopman_ros.parameters.table import parameter, ParameterTable

    @dataclass(frozen=True)
    class Wider(PlantParameters):
        leak: float = parameter(0.5, 'Share of the level that leaks', '1/min', 0.0, 2.0)

    TABLE = ParameterTable(Wider, groups={'constants': ()})
    """
TYPE = """
    from koopman_ros.core.message_fields import FieldDefaults, KNOWN_TYPES

    KNOWN_TYPES['sensor_msgs/msg/BatteryState'] = FieldDefaults('voltage', 'V', 0.0, 1e3)
    """


@pytest.fixture
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
          ) -> Iterator[ModuleType]:
    """Return the module made of a text, in a folder that Python searches."""
    name = f'added_{request.node.callspec.id}'
    (tmp_path / f'{name}.py').write_text(textwrap.dedent(request.param))
    monkeypatch.syspath_prepend(tmp_path)
    # what it adds is gone with it
    with mock.patch.dict(message_fields.KNOWN_TYPES):
        yield importlib.import_module(name)


@pytest.mark.parametrize('added', [PLANT], indirect=True, ids=['plant'])
def test_a_plant_runs(added: ModuleType) -> None:
    tank = Process(added.leaking_tank(), 0, np.zeros(1), np.zeros(1))
    tank = tank.commanded(np.array([2.0]), 0).until(3 * NANOSECONDS)
    assert tank.x == pytest.approx([2.0 * (1.0 - np.exp(-3.0))], rel=1e-9)


@pytest.mark.parametrize('added', [ROW], indirect=True, ids=['parameter'])
def test_a_parameter_is_declared_checked_and_written(added: ModuleType, ros: Harness) -> None:
    def leak(value: str) -> float:
        node = LoopNode('tank', context=ros.node.context,
                        cli_args=['--ros-args', '-p', f'leak:={value}'])
        try:
            return node.declare_table(added.TABLE).leak
        finally:
            node.destroy_node()

    assert leak('1.5') == 1.5
    with pytest.raises(ConfigurationError, match=r'^leak = 3.0 1/min must be in \[0, 2\] 1/min$'):
        leak('3.0')
    assert ('    # Share of the level that leaks [1/min]\n    #   [0, 2] 1/min\n    leak: 0.5\n'
            in added.TABLE.yaml())


@pytest.mark.parametrize('added', [TYPE], indirect=True, ids=['type'])
@pytest.mark.usefixtures('added', 'type_support')
def test_a_message_type_is_learned_from(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run') as writer:
        writer.add_topic('/cell', message_definition('sensor_msgs/msg/BatteryState'))
        for second, voltage in enumerate((3.5, -1.0, 3.75), 1):
            message = BatteryState(voltage=voltage)
            message.header.stamp.sec = second
            writer.write('/cell', serialize_message(message), second * NANOSECONDS)
    where = message_fields.place('/cell', 'cell', 'mV', {'type': 'sensor_msgs/msg/BatteryState'})
    assert where == message_fields.MessageField('/cell', 'sensor_msgs/msg/BatteryState', 'voltage',
                                                'V')
    series = read_series(tmp_path / 'run', where)
    assert (series.values.tolist(), series.unit) == ([3.5, -1.0, 3.75], 'V')
    assert where.range == (0.0, 1e3)
