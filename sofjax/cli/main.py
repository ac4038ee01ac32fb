"""Where arguments come in and exceptions become an exit code."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

from sofjax.cli import calibrate, demo, evaluate, inspect, run, simulate
from sofjax.io.errors import InputError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    **Returns:** 0; 2 with a sentence on stderr for what the user gave and nobody can use; 130
    after Ctrl-C; 1 if the system failed, such as by a full disk.
    """
    try:
        args = _parser().parse_args(argv)
        return args.run(args)
    except SystemExit as end:  # argparse has printed its own
        return end.code if isinstance(end.code, int) else 0
    except InputError as error:
        print(f"sofjax: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("sofjax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"sofjax: {error.filename or 'the system'}: {error.strerror}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sofjax", description="Segments-on-floor SLAM: a drive in, a trajectory and a map out."
    )
    parser.add_argument("--version", action="version", version=f"sofjax {version('sofjax')}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (run, evaluate, inspect, calibrate, simulate, demo):
        command.add_parser(commands)
    return parser
