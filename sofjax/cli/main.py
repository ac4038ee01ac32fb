"""Where arguments come in and exceptions become an exit code."""

import os
import sys
from collections.abc import Sequence

from sofjax.cli import (
    calibrate_camera,
    calibrate_robot,
    demo,
    evaluate,
    inspect,
    run,
    simulate,
)
from sofjax.cli.arguments import make_parser
from sofjax.io.errors import InputError, quoted
from sofjax.pipeline import stopping

COMMANDS = {
    "run": run.run,
    "evaluate": evaluate.run,
    "inspect": inspect.run,
    "calibrate camera": calibrate_camera.run,
    "calibrate robot": calibrate_robot.run,
    "calibrate mount": calibrate_robot.run,
    "simulate": simulate.run,
    "demo": demo.run,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    **Returns:** 0; 2 with a sentence on stderr for what the user gave and nobody can use; 130
    after Ctrl-C and 143 after SIGTERM, when what was done until then is written; 1 if the system
    failed, such as by a full disk, with the file's name.
    """
    with stopping.listening():
        try:
            args = make_parser().parse_args(argv)
            _keep_compilations()
            return COMMANDS[args.command](args)
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
