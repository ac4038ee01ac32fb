"""The command line: parse, call `sofjax.pipeline`, print. One file a command, each with `run`.

What is slow to import is imported inside `run`, so that `--help` answers at once.
"""

from sofjax.cli.main import main as main
