# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The input of a replay: records and commands of a controller in a bag, and their models."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
import contextlib
import os
from pathlib import Path

from koopman_ros.core.units import NANOSECONDS
from koopman_ros.event_log.records import EventRecord, parse, RecordError, SNAPSHOT, START
from koopman_ros.model import LiftedModel, load_with_digest, ModelFileError
from koopman_ros.records import BagMessage, BagReadError, read_messages, summary

RECORD_TYPE = 'std_msgs/msg/String'


def read_records(path: str | os.PathLike[str], topic: str, *, recover: bool = False
                 ) -> Iterator[EventRecord]:
    """
    Iterate over the records on a topic of a bag, in the order of receipt.

    `recover` is that of :func:`read_messages`. Raises BagReadError for a bag that cannot be read,
    or holds none.
    """
    # first, for its error if the file is no bag
    messages = read_messages(path, (topic,), recover=recover)
    content = summary(path)
    if not content.counts.get(topic):
        known = ', '.join(name for name, count in sorted(content.counts.items()) if count)
        raise BagReadError(
            f'bag {os.fspath(path)!r} has no records of a controller on {topic!r}; its topics are '
            f'{known or "none"}: record that topic, or remap it, e.g. -r {topic[1:]}:=NAME')
    if content.types[topic] != RECORD_TYPE:
        raise BagReadError(
            f'topic {topic!r} of bag {os.fspath(path)!r} is {content.types[topic]} and not '
            f'{RECORD_TYPE}: choose another topic by a remap, e.g. -r {topic[1:]}:=NAME')
    return _parsed(path, messages)


def lately(records: Iterable[EventRecord], seconds: float) -> Iterator[EventRecord]:
    """Return those records that a replay of the last seconds needs, from a snapshot on."""
    parts: deque[tuple[int, list[EventRecord]]] = deque()
    latest = 0
    for record in records:
        latest = max(latest, record.stamp_ns)
        if not parts or record.event in (START, SNAPSHOT):
            parts.append((latest, []))
        parts[-1][1].append(record)
        while len(parts) > 1 and parts[1][0] <= latest - seconds * NANOSECONDS:
            parts.popleft()
    return (record for _, part in parts for record in part)


def _parsed(path: str | os.PathLike[str], messages: Iterator[BagMessage]) -> Iterator[EventRecord]:
    for entry in messages:
        try:
            yield parse(entry.message.data)
        except (RecordError, AttributeError) as error:
            raise BagReadError(f'bag {os.fspath(path)!r}, topic {entry.topic!r}: {error}'
                               ) from error


def find_model(places: Sequence[Path], name: str, digest: str) -> LiftedModel:
    """
    Return the model whose file has a SHA-256 digest.

    :param places: files and folders that are searched.
    :param name: of the model, as recorded; first the file of that name, if it is one.
    :raises RecordError: if there is no such file.
    """
    files = [Path(name).expanduser()] if name.endswith('.safetensors') else []
    for place in places:
        files += sorted(place.glob('*.safetensors')) if place.is_dir() else [place]
    for path in files:
        with contextlib.suppress(ModelFileError, OSError):
            model, found = load_with_digest(path)
            if found == digest:
                return model
    raise RecordError(
        f'the controller ran with the model {name} (SHA-256 {digest[:12]}...), which is neither '
        'bundled nor found: set the parameter model to its file or folder')
