# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages decoded by the definition that their file brings along, by the library rosbags."""

from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
import re
from typing import Any, NamedTuple
import warnings

from mcap.well_known import MessageEncoding, SchemaEncoding
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from koopman_ros.core.message_fields import full_type_name
from koopman_ros.records.mcap_file import BagReadError, reason, stored_messages, StoredMessage

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


def decoded_messages(files: Iterable[Path], topics: frozenset[str] | None, recover: bool
                     ) -> Iterator[BagMessage]:
    """
    Yield the messages of some files; arguments and errors are those of ``read_messages``.

    Where all topics are read, those that are not decoded here come as bytes, with a warning each.
    """
    undecoded: set[str] = set()
    for file in files:
        # of each file by itself: identifiers of channels are a file's own
        decoders: dict[int, _Decode | None] = {}
        for stored in stored_messages(file, recover=recover, topics=topics):
            channel, fields = stored.channel, None
            if channel.id not in decoders:
                try:
                    decoders[channel.id] = _channel_decoder(stored)
                except BagReadError as error:
                    sentence = f'{str(file)!r}: {error}: read the other topics by name'
                    if topics is not None:
                        raise BagReadError(sentence) from error
                    decoders[channel.id] = None
                    if channel.topic not in undecoded:
                        undecoded.add(channel.topic)
                        warnings.warn(f'messages on {channel.topic!r} are returned as raw bytes: '
                                      f'{sentence}', stacklevel=2)
            if decode := decoders[channel.id]:
                try:
                    fields = decode(stored.data)
                except Exception as error:
                    # the decoder fails in as many ways as bytes of another program can be wrong
                    raise BagReadError(
                        f'{str(file)!r}: the message on {channel.topic!r} at {stored.log_time_ns} '
                        f'ns cannot be decoded ({reason(error)}): read the other topics by '
                        'name') from error
            yield BagMessage(channel.topic, type_name(stored), stored.log_time_ns,
                             stored.publish_time_ns, fields, stored.data)


def _channel_decoder(stored: StoredMessage) -> _Decode:
    """Return the decoder of a channel; BagReadError for a type or an encoding not decoded here."""
    schema, channel = stored.schema, stored.channel
    encodings = channel.message_encoding, schema.encoding if schema else 'no schema'
    if schema is None or encodings != (MessageEncoding.CDR, SchemaEncoding.ROS2):
        raise BagReadError(f'topic {channel.topic!r} is encoded as {encodings[0]!r} with '
                           f'{encodings[1]!r}, but only cdr with ros2msg is supported')
    try:
        return _decoder(type_name(stored), schema.data)
    except Exception as error:
        # the parser fails in many ways on the definition of another recorder
        raise BagReadError(f'the message definition stored for {channel.topic!r} is invalid '
                           f'({reason(error)})') from error


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
    # The store's own deserialize_cdr rejects more than three bytes behind a message, where ROS
    # leaves four behind an empty array of doubles.
    orders = found.deserialize_cdr_be, found.deserialize_cdr_le

    def decode(data: bytes) -> Any:
        message, end = orders[data[1] & 1](data[4:], 0, found.cls, store)
        if end > len(data) - 4:
            raise EOFError(f'{len(data)} bytes instead of {end + 4}')
        return message

    return decode
