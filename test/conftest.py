# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What holds for all tests: order, skips, checked messages, threads, disturbed trainings."""

from collections.abc import Iterator
import gc
import os
import signal
import sys

import pytest

# Before numpy is imported, and for the processes that tests start: small problems are slower on
# several threads, and far slower where others use the cores.
os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('MKL_NUM_THREADS', '1')

# A run in the background begins without interrupts, and so would each process that it starts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

from koopman_ros.process_entry import SIGNALS
from support import forked, INSTALL_CHROMIUM
from support.disturbance import disturb_training

# An int in a float64 field, say, passes unnoticed here, and aborts the process where the message
# packages are built with asserts. The packages read this when they are imported.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'

# What takes longest, first: where each core takes the next file, none is then idle at the end.
LONGEST = ('test_browser', 'test_demo', 'test_unmeasured_states', 'test_training_node',
           'test_shipped_models', 'test_examples', 'test_own_plant', 'test_studies',
           'test_classes', 'test_parallel', 'test_experiment_tanks', 'test_replay',
           'test_kalman_filters', 'test_panel', 'test_c_code', 'test_lag', 'test_several_states',
           'test_closed_loop_test', 'test_disturbance_observer', 'test_experiment_node',
           'test_controller_process', 'test_reload', 'test_characteristics', 'test_benchmarks',
           'test_controller_node', 'test_processes', 'test_server', 'test_acceptance',
           'test_managed', 'test_player', 'test_pipeline', 'test_late_candidates',
           'test_dead_time', 'test_recording', 'test_contained_failures', 'test_parameter_ends',
           'test_law', 'test_fault_campaign', 'test_plant_node', 'test_install_tree',
           'test_identify', 'test_simulate', 'test_supervisor', 'test_learn', 'test_non_affine',
           'test_replay_job', 'test_measured_disturbances', 'test_partly_measured',
           'test_backends', 'test_estimates')


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """
    Exclude all that the test modules hold from garbage collections: 0.3 s for each.

    Nodes are forked where a test module starts some.
    """
    gc.disable()
    yield
    if testing := sys.modules.get('koopman_ros.testing'):
        testing.NodeProcess.popen = staticmethod(forked.start)
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, the others in their order."""
    order = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport() -> Iterator[None]:
    """Fail a test that skips where all are required: in continuous integration."""
    report = (yield).get_result()
    if report.skipped and not hasattr(report, 'wasxfail') and os.environ.get('CI') == 'true':
        report.outcome = 'failed'
        report.longrepr = f'skipped, although CI=true requires every test: {report.longrepr[2]}'


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """Say at the end how many tests a browser would add."""
    yield
    skipped = [report for report in terminalreporter.stats.get('skipped', ())
               if INSTALL_CHROMIUM in str(report.longrepr)]
    if skipped:
        terminalreporter.write_line(
            f'{len(skipped)} tests with a browser were skipped. To run them, install Chromium: '
            f'{INSTALL_CHROMIUM}')


@pytest.fixture(autouse=True)
def own_signals() -> Iterator[None]:
    """Restore the handlers of signals: what a program ignores at its end, children inherit."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        if signal.getsignal(number) is not handler:
            signal.signal(number, handler)


def pytest_configure() -> None:
    """Disturb the data of all trainings where the environment asks for it."""
    disturb_training()
