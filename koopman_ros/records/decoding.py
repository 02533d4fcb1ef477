# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages decoded by the definition that their file brings along, by the library rosbags."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
import re
from typing import Any, NamedTuple

from mcap.well_known import MessageEncoding, SchemaEncoding
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from koopman_ros.core.message_fields import full_type_name
from koopman_ros.records.mcap_file import BagReadError, reason, StoredMessage

_Decode = Callable[[bytes], Any]

# A byte is unsigned in ROS 2, in rosbags it is not.
_BYTE = re.compile(r'^\s*byte\b', re.MULTILINE)
# Definitions of some writers leave them out.
_TIMES = {
    **get_types_from_msg('int32 sec\nuint32 nanosec', 'builtin_interfaces/msg/Time'),
    **get_types_from_msg('int32 sec\nuint32 nanosec', 'builtin_interfaces/msg/Duration')}


class BagMessage(NamedTuple):
    """
    One message of a bag: times of receipt and of sending [ns], decoded fields, original bytes.

    `message` has the fields of the ROS message as attributes (`message.header.stamp.sec`); it is
    None for a type that is not decoded here.
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    message: Any
    data: bytes


class UndecodableError(BagReadError):
    """A topic whose type or encoding is not decoded here; its messages may be complete."""


class Decoders:
    """Decode the messages of one file."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._by_channel: dict[int, tuple[str, _Decode | UndecodableError]] = {}

    def decode(self, stored: StoredMessage) -> BagMessage:
        """Return a message with its fields; raise BagReadError where that is impossible."""
        type_name, decode = self._by_channel.get(stored.channel.id) or self._prepared(stored)
        if isinstance(decode, UndecodableError):
            raise decode.with_traceback(None)
        try:
            fields = decode(stored.data)
        except Exception as error:
            # the decoder walks over foreign bytes and fails in as many ways as they can be wrong
            raise BagReadError(
                f'{str(self._file)!r}: the message on {stored.channel.topic!r} at '
                f'{stored.log_time_ns} ns does not decode ({reason(error)}): read the other '
                'topics by name') from error
        return BagMessage(stored.channel.topic, type_name, stored.log_time_ns,
                          stored.publish_time_ns, fields, stored.data)

    def undecoded(self, stored: StoredMessage) -> BagMessage:
        """Return a message with its bytes alone."""
        return BagMessage(stored.channel.topic, type_name(stored), stored.log_time_ns,
                          stored.publish_time_ns, None, stored.data)

    def _prepared(self, stored: StoredMessage) -> tuple[str, _Decode | UndecodableError]:
        schema, channel = stored.schema, stored.channel
        encodings = channel.message_encoding, schema.encoding if schema else 'no schema'
        decode: _Decode | UndecodableError
        if schema is None or encodings != (MessageEncoding.CDR, SchemaEncoding.ROS2):
            decode = UndecodableError(
                f'{str(self._file)!r}: topic {channel.topic!r} is encoded as {encodings[0]!r} '
                f'with {encodings[1]!r}, only cdr with ros2msg is decoded here: read the other '
                'topics by name')
        else:
            try:
                decode = _decoder(type_name(stored), schema.data)
            except Exception as error:
                # the definition of another recorder meets the parser here
                decode = UndecodableError(
                    f'{str(self._file)!r}: the definition stored for {channel.topic!r} does not '
                    f'parse ({reason(error)}): read the other topics by name')
        return self._by_channel.setdefault(channel.id, (type_name(stored), decode))


def type_name(stored: StoredMessage) -> str:
    """Return the full name of a message's type, '' without a schema."""
    return full_type_name(stored.schema.name) if stored.schema else ''


@cache
def _decoder(name: str, definition: bytes) -> _Decode:
    """Return the function that decodes messages of a type; raise any exception without one."""
    store = get_typestore(Stores.EMPTY)
    store.register({**_TIMES, **get_types_from_msg(
        _BYTE.sub('uint8', definition.decode('utf-8')), name)})
    found = store.get_msgdef(name)
    # The store's own deserialize_cdr refuses more than three bytes behind a message, where ROS
    # leaves four behind an empty array of doubles.
    orders = found.deserialize_cdr_be, found.deserialize_cdr_le

    def decode(data: bytes) -> Any:
        message, end = orders[data[1] & 1](data[4:], 0, found.cls, store)
        if end > len(data) - 4:
            raise EOFError(f'{len(data)} bytes, {end + 4} are needed')
        return message

    return decode
