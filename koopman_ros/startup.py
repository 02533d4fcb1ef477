# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""
First steps of a program, before anything large is loaded, and its end by force.

What is imported here is imported before signals are handled, so it is little. Only a child that
is started by :func:`command` and :func:`blocked_signals` handles them from its very start.
"""

import atexit
from collections.abc import Callable, Iterator, Sequence
import contextlib
import ctypes
import faulthandler
from functools import partial
import gc
import importlib
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

# One thread of each library of linear algebra. A control step takes a fraction of a millisecond,
# and twenty where several threads share it on busy cores; and the last bit of a command depends on
# the number of threads.
ONE_THREAD = {f'{library}_NUM_THREADS': '1' for library in ('OMP', 'OPENBLAS', 'MKL')}
# Their results are compared bit by bit: no variable of the user changes the number of threads.
_BIT_IDENTICAL = tuple(
    f'koopman_ros.nodes.{name}' for name in ('plant', 'controller', 'player', 'replay'))

_PR_SET_PDEATHSIG = 1  # of prctl(2)
_END = 8.0  # s from the end of a program to that by force
_QUIET = 1.0  # s after an interrupt in which another one is the same
_SIGEV_THREAD = 2  # of sigevent(3type): the function is called in a thread of its own
_LATER = 3.0  # s from the sentence, which some thread can say, to the stack
_AFTER = 0.5  # s from the stack that is printed to the end


def run_program(module: str, interrupted: int) -> int:
    """Run a module's `main`, whatever signals come; return its exit code, or `interrupted`."""
    open_standard_streams()
    ended: list[int] = []
    # the last of those that are called, as the first one that is registered
    atexit.register(_end_at_once, ended)
    # numpy and rclpy take a quarter of a second, in which there is nothing to complete
    handle_signals(lambda *_: os._exit(interrupted))
    if module in _BIT_IDENTICAL:
        os.environ.update(ONE_THREAD)
    # what is imported stays: nobody is to look through it for garbage again and again, now or at
    # the end
    gc.disable()
    main = importlib.import_module(module).main
    gc.freeze()
    gc.enable()
    _raise_interrupts()
    code = 1
    try:
        code = main()
        ended.append(code)
    except KeyboardInterrupt:
        code = interrupted
        ended.append(code)
    finally:
        handle_signals(signal.SIG_IGN)
        # what libraries do at the interpreter's own end may hang, too
        end_by_force(_END, code)
    return code


def _end_at_once(ended: list[int]) -> None:
    """End the process with its code, where its program has ended; all else is done by now."""
    if not ended:
        return
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        # the interpreter's own end says so
        return
    # What is left is to take down objects and libraries one by one, for which the operating system
    # needs a fraction of a millisecond: Fast DDS waits a tenth of a second in there.
    os._exit(ended[0])


def open_standard_streams() -> None:
    """Open what is closed of the three standard streams, to nowhere."""
    # the next file or socket would take its number, and what a library prints would go there
    for number, name in enumerate(('stdin', 'stdout', 'stderr')):
        try:
            os.fstat(number)
        except OSError:
            # takes the lowest free number, which is this one
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            stream = os.fdopen(number, 'r' if number == 0 else 'w', closefd=False)
            setattr(sys, name, stream)
            setattr(sys, f'__{name}__', stream)


def handle_signals(handler: Any) -> None:
    """Handle signals so; at the end they are ignored, for Python gives up its handlers early."""
    for number in SIGNALS:
        signal.signal(number, handler)


def _raise_interrupts() -> None:
    last = -_QUIET

    def interrupt(_: int, __: FrameType | None) -> None:
        nonlocal last
        # a second one would end in the middle what the first has made to end
        if time.monotonic() - last >= _QUIET:
            last = time.monotonic()
            raise KeyboardInterrupt

    handle_signals(interrupt)


class _Event(ctypes.Structure):
    """sigevent of timer_create(2), with room to spare."""

    _fields_ = (('value', ctypes.c_void_p), ('signal', ctypes.c_int), ('notify', ctypes.c_int),
                ('function', ctypes.c_void_p), ('rest', ctypes.c_char * 64))


def end_by_force(seconds: float, code: int = 0, sentence: str = '') -> Callable[[], None]:
    """
    End the process then, with a sentence; where no Python runs, print where it hangs and end it.

    The latter comes some seconds later, or at once without a sentence, and takes no lock of the
    interpreter's: Python prints from a thread of its own, and the C library ends the process.

    :return: takes that back.
    """
    def give_up() -> None:
        print(sentence, file=sys.stderr, flush=True)
        os._exit(code)

    said = threading.Timer(seconds, give_up)
    if sentence:
        said.daemon = True
        said.start()
        seconds += _LATER
    cancel = _exit_later(seconds + _AFTER, code)
    # where standard error is no file it says nothing
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        faulthandler.dump_traceback_later(seconds, exit=cancel is None)

    def disarm() -> None:
        said.cancel()
        faulthandler.cancel_dump_traceback_later()
        if cancel is not None:
            cancel()

    return disarm


def _exit_later(seconds: float, code: int) -> Callable[[], object] | None:
    """Let the C library end the process then; return what takes it back, None where it cannot."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, 'timer_create'):
        return None
    # _exit(value)
    event = _Event(code, 0, _SIGEV_THREAD, ctypes.cast(libc._exit, ctypes.c_void_p))
    timer = ctypes.c_void_p()
    if libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        return None
    # the interval, and the time until the first; each in seconds and nanoseconds
    due = (ctypes.c_long * 4)(0, 0, int(seconds), int(seconds % 1.0 * 1e9))
    if libc.timer_settime(timer, 0, ctypes.byref(due), None):
        return None
    return lambda: libc.timer_delete(timer)


def command(module: str, number: int, interrupted: int) -> tuple[str, ...]:
    """Return the command line of a child that gets a signal when this process ends, however."""
    # the signal comes when the thread ends that started the child
    parent = os.getpid() if threading.current_thread() is threading.main_thread() else 0
    return (sys.executable, '-m', 'koopman_ros.startup', str(parent), str(int(number)),
            str(interrupted), module)


@contextlib.contextmanager
def blocked_signals() -> Iterator[None]:
    """Block signals in a child started meanwhile, until it handles them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_child(parent: int, number: int, interrupted: int, module: str,
              arguments: Sequence[str]) -> int:
    """
    Run a module's `main` in a child whose signals are blocked; return its exit code.

    :param parent: at whose end the child gets the signal `number`; 0 for none.
    :param interrupted: exit code after a signal.
    """
    libc = ctypes.CDLL(None)
    if parent and hasattr(libc, 'prctl'):
        libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)
        if os.getppid() != parent:
            # it has ended before
            os._exit(0)
    sys.argv = [module, *arguments]
    handle_signals(lambda *_: os._exit(interrupted))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    return run_program(module, interrupted)


def main() -> int:
    """Run a child; see :func:`command`."""
    parent, number, interrupted, module, *arguments = sys.argv[1:]
    return run_child(int(parent), int(number), int(interrupted), module, arguments)


# The programs on the path. A node that is ended by a signal has done its work: 0. A replay has
# not: 130.
plant = partial(run_program, 'koopman_ros.nodes.plant', 0)
controller = partial(run_program, 'koopman_ros.nodes.controller', 0)
trainer = partial(run_program, 'koopman_ros.nodes.trainer', 0)
player = partial(run_program, 'koopman_ros.nodes.player', 0)
replay = partial(run_program, 'koopman_ros.nodes.replay', 130)
panel = partial(run_program, 'koopman_ros.nodes.panel', 0)

if __name__ == '__main__':
    sys.exit(main())
