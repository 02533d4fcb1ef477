# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The order in which messages of several topics arrived, out of the order in the file."""

from collections.abc import Iterable, Iterator
import heapq

from koopman_ros.bags.reader import BagMessage

# A recorder that falls behind writes what waits topic by topic; longer than this it never waits.
BEHIND_NS = 5_000_000_000


def in_log_order(messages: Iterable[BagMessage], behind_ns: int = BEHIND_NS
                 ) -> Iterator[BagMessage]:
    """
    Yield messages by their log time, as `ros2 bag play` does, within runs of one clock.

    A message goes ahead of those recorded before it when it was received earlier, by at most
    `behind_ns` [ns]. One that is earlier by more tells of a clock that was set back: all that
    came before it stays before it. Messages of one log time keep their order.
    """
    waiting: list[tuple[int, int, BagMessage]] = []
    newest_ns = 0
    for place, message in enumerate(messages):
        time_ns = message.log_time_ns
        if waiting and time_ns < newest_ns - behind_ns:
            yield from (entry for _, _, entry in sorted(waiting))
            waiting, newest_ns = [], time_ns
        newest_ns = max(newest_ns, time_ns)
        heapq.heappush(waiting, (time_ns, place, message))
        while waiting[0][0] < newest_ns - behind_ns:
            yield heapq.heappop(waiting)[2]
    yield from (entry for _, _, entry in sorted(waiting))
