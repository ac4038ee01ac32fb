"""The command line. One file a command, each with `add_parser` and `run`.

What is slow to import is imported inside `run`, so that `--help` answers at once.
"""

from sofjax.cli.main import main as main
