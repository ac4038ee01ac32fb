"""Ctrl-C and SIGTERM: when they stop a command, and its exit code then.

`main` listens while a command runs. A signal raises `KeyboardInterrupt`. It waits while a module is
being imported, since a module that is half imported cannot be used, and in a block of `held`. Where
Python swallows the exception, as in callbacks of the garbage collector, it is raised again a little
later. A second signal does not wait.

A program that uses the library installs no handlers: there `held` and `allowed` do nothing, and
Ctrl-C raises `KeyboardInterrupt` as usual.
"""

import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

STOP = (signal.SIGINT, signal.SIGTERM)
AGAIN = 0.05  # seconds until a signal that had to wait is looked at again
SECOND = 0.5  # seconds after the first; what comes sooner was sent along with it


class _Listener:
    """The handler of the signals, and what is known of them."""

    def __init__(self) -> None:
        self.code = 128 + signal.SIGINT  # exit code
        self.first: float | None = None  # clock at the first signal
        self.pending = False  # a signal has come and has not stopped anything yet
        self.held = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        second = False
        if number in STOP:
            now = time.monotonic()
            if self.first is not None and now - self.first < SECOND:
                return
            second = self.first is not None
            self.first, self.pending, self.code = self.first or now, True, 128 + number
        if self.held and not second:
            return
        if _importing(frame) and not second:
            self.come_again()
            return
        self.stop()

    def stop(self) -> None:
        """Raise if there is something to raise."""
        if self.pending:
            self.pending = False
            raise KeyboardInterrupt

    def come_again(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, AGAIN)


_listener = _Listener()
_listening = False


@contextmanager
def listening() -> Iterator[None]:
    """Handle the signals in this block, which is a command; those that are ignored stay so.

    A command within a command and one outside the main thread leave them as they are.
    """
    global _listener, _listening
    if _listening or threading.current_thread() is not threading.main_thread():
        yield
        return
    _listener, _listening = _Listener(), True
    hook = sys.unraisablehook

    def swallowed(unraisable: "sys.UnraisableHookArgs") -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            _listener.pending = True
            _listener.come_again()
        else:
            hook(unraisable)

    taken = [s for s in STOP if signal.getsignal(s) not in (signal.SIG_IGN, None)]
    before = {number: signal.getsignal(number) for number in (*taken, signal.SIGALRM)}
    sys.unraisablehook = swallowed
    for number in before:
        signal.signal(number, _listener)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook
        _listening = False


@contextmanager
def held() -> Iterator[None]:
    """Signals wait in this block, apart from blocks of `allowed` in it, until its end at most."""
    _listener.held = True
    try:
        yield
    finally:
        _listener.held = False
    _listener.stop()


@contextmanager
def allowed() -> Iterator[None]:
    """Within `held`: a signal that came before or comes now raises `KeyboardInterrupt`."""
    _listener.held = False
    try:
        _listener.stop()
        yield
    finally:
        _listener.held = True


def exit_code() -> int:
    """130 after Ctrl-C, 143 after SIGTERM."""
    return _listener.code


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
