"""`python -m sofjax`."""

import sys

from sofjax.cli import main

if __name__ == "__main__":
    sys.exit(main())
