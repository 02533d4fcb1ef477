# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Every backend, opened once."""

import contextlib
import logging
import warnings

from koopman_ros.execution import backend_of

KINDS = ('', 'process', 'joblib:2', 'dask')


@contextlib.contextmanager
def places(kinds=KINDS):
    """Yield backends by kind; the Dask cluster has two threads in this process."""
    with contextlib.ExitStack() as stack:
        with warnings.catch_warnings():
            # its own imports
            warnings.simplefilter('ignore')
            import distributed
        # its ports are free ones of the loopback interface
        cluster = stack.enter_context(distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, host='127.0.0.1',
            protocol='tcp://', dashboard_address='127.0.0.1:0', silence_logs=logging.CRITICAL))
        yield {kind: stack.enter_context(backend_of(
            cluster.scheduler_address if kind == 'dask' else kind)) for kind in kinds}
