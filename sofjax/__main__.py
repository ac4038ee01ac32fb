"""The program: `sofjax`, and `python -m sofjax`."""

import contextlib
import os
import signal
import sys


def main() -> int:
    """Run the command; Ctrl-C and SIGTERM end it quietly from the first moment on."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _leave)
    from sofjax.cli import main

    code = main()
    if code > 128:  # a compilation that was cut short has a thread, and the end would wait for it
        with contextlib.suppress(OSError):
            sys.stdout.flush()
        os._exit(code)
    return code


def _leave(number: int, _: object) -> None:
    """While not even the command's module is imported there is nothing to save."""
    os.write(2, b"sofjax: interrupted\n")
    os._exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
