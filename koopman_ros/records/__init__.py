# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Records of plants: tables, and bags of rosbag2 (MCAP), written and read without ROS."""

from koopman_ros.records.decoding import BagMessage
from koopman_ros.records.episodes import stream_episodes
from koopman_ros.records.import_spec import ImportReport, RecordedInput, RecordedState
from koopman_ros.records.mcap_file import BagReadError
from koopman_ros.records.message_definitions import (
    message_definition,
    MessageDefinition,
    MessageDefinitionError,
)
from koopman_ros.records.reader import BagSummary, in_log_order, read_messages, summary
from koopman_ros.records.record import read, Record
from koopman_ros.records.series import read_series, Series
from koopman_ros.records.writer import BagWriter

__all__ = [
    'BagMessage',
    'BagReadError',
    'BagSummary',
    'BagWriter',
    'ImportReport',
    'MessageDefinition',
    'MessageDefinitionError',
    'Record',
    'RecordedInput',
    'RecordedState',
    'Series',
    'in_log_order',
    'message_definition',
    'read',
    'read_messages',
    'read_series',
    'stream_episodes',
    'summary',
]
