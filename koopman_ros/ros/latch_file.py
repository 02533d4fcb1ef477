# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""The latch of the safe state, kept over a restart of the process, e.g. a respawn."""

import os
from pathlib import Path

from rclpy.node import Node


class LatchFile:
    """
    An empty file for as long as the safe state of a node is latched.

    It is ``$ROS_HOME/koopman_ros/<domain><name>.latched``, by default below ``~/.ros``.

    :ivar marked: whether it is there.
    """

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        home = Path(os.environ.get('ROS_HOME') or '~/.ros').expanduser()
        name = node.get_fully_qualified_name().replace('/', '.')
        self._path = home / 'koopman_ros' / f'{os.environ.get("ROS_DOMAIN_ID", 0)}{name}.latched'
        self.marked = self._path.exists()

    def update(self, latched: bool) -> None:
        """Create or remove the file after a change."""
        if latched == self.marked:
            return
        self.marked = latched
        try:
            if latched:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._path.touch()
            else:
                self._path.unlink(missing_ok=True)
        except OSError as error:
            self._log.error(
                f'{self._path} cannot be {"written" if latched else "removed"} ({error}), so '
                f'after a restart the safe state will {"not " if latched else ""}be latched: '
                'check its folder, or set ROS_HOME to a writable one')
