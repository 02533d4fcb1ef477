# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Entry of every program: standard streams, one BLAS thread, signals; before large imports."""

import atexit
from collections.abc import Callable, Iterator, Sequence
import contextlib
import faulthandler
from functools import partial
import importlib
import os
import select
import signal
import sys
import threading
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# A control step takes a fraction of a millisecond, and twenty where several threads share it on
# busy cores; and the last bit of a command depends on the number of threads.
ONE_THREAD = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL')}
_ONE_THREAD_PROGRAMS = ('koopman_ros.learn_files', 'koopman_ros.export.command_line', *(
    f'koopman_ros.nodes.{name}' for name in ('plant', 'controller', 'player', 'replay')))


def run_program(module: str, interrupted: int, patience: float = 0.0) -> int:
    """
    Run the `main` of a module; return its exit code, or `interrupted` after a signal.

    :param patience: time in s after which the process ends, whatever it does after a signal; 0: it
        may take its time.
    """
    open_standard_streams()
    codes: list[int] = []
    # registered first, so that it is called last
    atexit.register(_exit, codes)
    # nothing has to be completed while modules are imported
    handle_signals(lambda *_: os._exit(interrupted))
    if module in _ONE_THREAD_PROGRAMS:
        os.environ.update(ONE_THREAD)
    main = importlib.import_module(module).main
    caught = threading.Event()
    if patience:
        _end_soon_after_signals(patience, interrupted, caught)
    handle_signals(_interrupt)
    try:
        codes.append(main())
    except KeyboardInterrupt:
        codes.append(interrupted)
        caught.set()
        if patience:
            threading.Event().wait()  # for the end by the thread, which says so
    finally:
        handle_signals(signal.SIG_IGN)
    return codes[0]


def _exit(codes: Sequence[int]) -> None:
    """End the process before the interpreter does, where threads of rclpy crash or hang."""
    if codes:
        print(end='', flush=True)
        print(end='', file=sys.stderr, flush=True)
        os._exit(codes[0])


def open_standard_streams() -> None:
    """Open closed standard streams to the null device: a later file would take their numbers."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def handle_signals(handler: Any) -> None:
    """Set the handler of every signal that ends a program."""
    for number in SIGNALS:
        signal.signal(number, handler)


def _interrupt(*_: object) -> None:
    # a second signal would interrupt the clean end
    handle_signals(signal.SIG_IGN)
    raise KeyboardInterrupt


def _end_soon_after_signals(seconds: float, code: int, caught: threading.Event) -> None:
    """End the process when a signal was caught, or some seconds after one that was missed."""
    # the interpreter writes to it at once, while a library still calculates
    seen, written = os.pipe()
    os.set_blocking(written, False)
    signal.set_wakeup_fd(written)

    def end() -> None:
        while os.read(seen, 1)[0] not in SIGNALS:
            pass
        caught.wait(seconds)
        print('interrupted; files that were written before are kept', file=sys.stderr, flush=True)
        os._exit(code)

    threading.Thread(target=end, daemon=True).start()


def force_exit_after(seconds: float, code: int = 0, sentence: str = '') -> Callable[[], None]:
    """
    End the process after some seconds, with a sentence; return a function that cancels this.

    Where a library holds the interpreter's lock, the process ends 1 s later with code 1 and a
    traceback.
    """
    def end() -> None:
        if sentence:
            print(sentence, file=sys.stderr, flush=True)
        os._exit(code)

    timer = threading.Timer(seconds, end)
    timer.daemon = True
    timer.start()
    faulthandler.dump_traceback_later(seconds + 1.0, exit=True, file=2)

    def cancel() -> None:
        timer.cancel()
        faulthandler.cancel_dump_traceback_later()

    return cancel


def command(module: str, number: int, interrupted: int) -> tuple[str, ...]:
    """Return the command line of a child that gets a signal when this process ends."""
    return (sys.executable, '-m', 'koopman_ros.process_entry', str(os.getpid()), str(int(number)),
            str(interrupted), module)


@contextlib.contextmanager
def blocked_signals() -> Iterator[None]:
    """Block signals in a child that is started meanwhile, until the child handles them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_child(parent: int, number: int, interrupted: int, module: str,
              arguments: Sequence[str]) -> int:
    """
    Run the `main` of a module in a child process; return its exit code.

    :param parent: process at whose end the child gets the signal `number`.
    :param interrupted: exit code after a signal.
    """
    sys.argv = [module, *arguments]
    handle_signals(lambda *_: os._exit(interrupted))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    threading.Thread(target=_signal_at_end, args=(parent, number), daemon=True).start()
    return run_program(module, interrupted)


def _signal_at_end(parent: int, number: int) -> None:
    # the process may have ended before
    with contextlib.suppress(ProcessLookupError):
        select.select([os.pidfd_open(parent)], [], [])
    os.kill(os.getpid(), number)


def main() -> int:
    """Run a child; see :func:`command`."""
    parent, number, interrupted, module, *arguments = sys.argv[1:]
    return run_child(int(parent), int(number), int(interrupted), module, arguments)


# The programs on the path. A signal completes the work of a node (0), and interrupts a replay.
plant = partial(run_program, 'koopman_ros.nodes.plant', 0)
controller = partial(run_program, 'koopman_ros.nodes.controller', 0)
trainer = partial(run_program, 'koopman_ros.nodes.trainer', 0)
player = partial(run_program, 'koopman_ros.nodes.player', 0)
replay = partial(run_program, 'koopman_ros.nodes.replay', 130)
panel = partial(run_program, 'koopman_ros.nodes.panel', 0)
learn = partial(run_program, 'koopman_ros.learn_files', 130, 0.5)
export_c = partial(run_program, 'koopman_ros.export.command_line', 130)
command_line = partial(run_program, 'koopman_ros.ros.command_line', 130)

if __name__ == '__main__':
    sys.exit(main())
