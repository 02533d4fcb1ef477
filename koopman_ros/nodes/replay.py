# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The replay: re-runs the control step on recorded bags, also with a new model."""

from collections.abc import Callable, Mapping
import sys
from typing import Any

from koopman_ros.event_log.run import replay_bags, Result, tuning
from koopman_ros.parameters.controller import REPLAY_TABLE, ReplayParameters
from koopman_ros.parameters.model_checks import load_suitable
from koopman_ros.ros import topics
from koopman_ros.ros.node import LoopNode
from koopman_ros.ros.process import run_task


def _prepare() -> Callable[[], int]:
    """Read parameters and names, which remaps and the namespace change as for the controller."""
    node = LoopNode('replay', start_parameter_services=False, enable_rosout=False)
    try:
        given = node.given()
        new_model = str(given.get('new_model', ''))
        # those of a controller with the new model may be given, too
        further = tuning(load_suitable(new_model, force=True).model, given) if new_model else ()
        parameters = node.declare_table(REPLAY_TABLE, further)
        topic = node.resolve_topic_name(topics.EVENT_LOG)
    finally:
        node.destroy_node()
    return lambda: _run(parameters, topic, given)


def _run(parameters: ReplayParameters, topic: str, given: Mapping[str, Any]) -> int:
    try:
        result = replay_bags(parameters, topic, given)
    except MemoryError:
        print('replay: out of memory: replay the bags one by one, or shorter '
              'ones', file=sys.stderr)
        return 1
    if result is Result.DIFFERENT:
        print(f'replay: not all recorded commands are reproduced within {parameters.tolerance:g}: '
              'see the report for the first difference, and replay with the package that recorded '
              'the bag', file=sys.stderr)
    elif result is Result.NOTHING_COMPARED:
        print('replay: nothing to compare in a bag: its records hold no snapshot before a '
              'command; use bags that begin with the run, or longer ones', file=sys.stderr)
    return result


def main(args: list[str] | None = None) -> int:
    """Run the replay."""
    return run_task('replay', _prepare, args)


if __name__ == '__main__':
    sys.exit(main())
