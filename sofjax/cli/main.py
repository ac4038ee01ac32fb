"""Where arguments come in and exceptions become an exit code."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import NoReturn

from sofjax.cli import calibrate, demo, evaluate, inspect, run, simulate, stopping
from sofjax.io.errors import InputError, quoted

QUOTED = 200  # characters of the message of a word that is no option


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    **Returns:** 0; 2 with a sentence on stderr for what the user gave and nobody can use; 130
    after Ctrl-C and 143 after SIGTERM, when what was done until then is written; 1 if the system
    failed, such as by a full disk, with the file's name.
    """
    with stopping.listening():
        try:
            args = _parser().parse_args(argv)
            _keep_compilations()
            return args.run(args)
        except SystemExit as end:  # argparse has printed its own
            return end.code if isinstance(end.code, int) else 0
        except InputError as error:
            print(f"sofjax: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("sofjax: interrupted", file=sys.stderr)
            return stopping.exit_code()
        except BrokenPipeError:  # the reader of our output has gone
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except OSError as error:
            print(f"sofjax: {error.filename or 'the system'}: {error.strerror}", file=sys.stderr)
            return 1


def _keep_compilations() -> None:
    """With SOFJAX_CACHE=DIR, what is compiled is kept there, and the next start reads it."""
    folder = os.environ.get("SOFJAX_CACHE")
    if not folder:
        return
    try:
        os.makedirs(folder, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        raise InputError(f"SOFJAX_CACHE: {quoted(folder)} must be a folder that can be written to")
    import jax

    jax.config.update("jax_compilation_cache_dir", os.path.abspath(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # many are small


class _Parser(argparse.ArgumentParser):
    """One that quotes little of what it was given."""

    def error(self, message: str) -> NoReturn:
        super().error(message if len(message) <= QUOTED else f"{message[:QUOTED]}...")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="sofjax", description="Segments-on-floor SLAM: a drive in, a trajectory and a map out."
    )
    parser.add_argument("--version", action="version", version=f"sofjax {version('sofjax')}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (run, evaluate, inspect, calibrate, simulate, demo):
        command.add_parser(commands)
    return parser
