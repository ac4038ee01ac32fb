"""Sphinx: `python -m sphinx -W --keep-going -b html docs build/docs`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import generate

import sofjax

project = "sofjax"
author = "the sofjax authors"
release = sofjax.__version__
extensions = ["myst_parser", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "sofjax"
exclude_patterns = ["*.py"]
nitpicky = True

generate.write(Path(__file__).parent)  # settings.md and api.md, from the code
