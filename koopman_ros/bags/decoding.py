# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Messages decoded by the definition that their file brings along."""

from collections.abc import Callable
import contextlib
from dataclasses import dataclass, replace
import io
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from mcap.records import Schema
from mcap.well_known import SchemaEncoding
from mcap_ros2.decoder import DecoderFactory

from koopman_ros.bags import limits
from koopman_ros.bags.records import StoredMessage
from koopman_ros.wire import full_type_name


@dataclass(frozen=True, slots=True)
class BagMessage:
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


class UndecodableError(limits.BagReadError):
    """A topic whose type or encoding is not decoded here; its messages may be whole."""


def type_name(schema: Schema | None) -> str:
    """Return the full name of a message type, '' without a schema."""
    return full_type_name(schema.name) if schema else ''


class _WholeSlices(bytes):
    """
    Bytes whose slices are complete or fail.

    The decoder takes whatever a slice returns for a string or a field of bytes: one cut short
    would pass for a shorter one, and a damaged length for that many empty ones.
    """

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice) and key.stop > len(self):
            raise EndOfFile
        return super().__getitem__(key)


class Decoders:
    """The decoders of one file's message types."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._factory = DecoderFactory()
        self._known: dict[tuple[str, int], Callable[[bytes], Any] | UndecodableError] = {}

    def decode(self, stored: StoredMessage) -> BagMessage:
        """Return a message with its fields; raise BagReadError where that cannot be."""
        channel, message = stored.channel, stored.message
        decode = self._prepare(stored)
        try:
            fields = decode(_WholeSlices(message.data))
        except MemoryError:
            raise
        except Exception as error:
            # The decoder walks over foreign bytes and fails in as many ways as they can be wrong.
            raise limits.BagReadError(
                f'{str(self._file)!r}: the message on {channel.topic!r} at {message.log_time} ns '
                f'does not decode ({limits.reason(error)}): read the other topics by name'
            ) from error
        return self.undecoded(stored, fields)

    @staticmethod
    def undecoded(stored: StoredMessage, fields: Any = None) -> BagMessage:
        """Return a message with its bytes, and with fields that were decoded before."""
        message = stored.message
        return BagMessage(stored.channel.topic, type_name(stored.schema), message.log_time,
                          message.publish_time, fields, message.data)

    def fields(self, stored: StoredMessage, data: bytes) -> Any:
        """Return the fields of other data on the channel of a message; it fails in any way."""
        return self._prepare(stored)(_WholeSlices(data))

    def _prepare(self, stored: StoredMessage) -> Callable[[bytes], Any]:
        key = stored.channel.message_encoding, stored.channel.schema_id
        if key not in self._known:
            try:
                self._known[key] = self._decoder(stored)
            except UndecodableError as error:
                self._known[key] = error
        known = self._known[key]
        if isinstance(known, UndecodableError):
            raise known.with_traceback(None)
        return known

    def _decoder(self, stored: StoredMessage) -> Callable[[bytes], Any]:
        schema, encoding = stored.schema, stored.channel.message_encoding
        try:
            if schema is not None and schema.encoding == SchemaEncoding.ROS2:
                schema = replace(schema, data=limits.fields_only(schema.data))
            # the definition parser prints what it also raises
            with contextlib.redirect_stderr(io.StringIO()):
                decoder = self._factory.decoder_for(encoding, schema)
        except MemoryError:
            raise
        except Exception as error:
            # Another recorder's schema text meets the definition parser here.
            raise UndecodableError(
                f'{str(self._file)!r}: the definition stored for {stored.channel.topic!r} does '
                f'not parse ({limits.reason(error)}): read the other topics by name') from error
        if decoder is None:
            schema_encoding = schema.encoding if schema else 'no schema'
            raise UndecodableError(
                f'{str(self._file)!r}: topic {stored.channel.topic!r} is encoded as {encoding!r} '
                f'with {schema_encoding!r}, only cdr with ros2msg is decoded here: read the other '
                'topics by name')
        return decoder
