# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Named pipes, at which a reader waits as at a slow disk."""

import errno
import os
from pathlib import Path
from typing import BinaryIO

from koopman_ros.testing import Harness


def opened(ros: Harness, pipe: Path) -> BinaryIO:
    """Wait until somebody reads from a named pipe, and return the end to write to."""
    def end() -> BinaryIO | None:
        try:
            return os.fdopen(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK), 'wb')
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            # nobody reads yet
            return None

    found = ros.wait_until(end)
    assert found is not None
    return found
