"""Lets the tests import bars.py beside this file and the shapes of `samples/`, which are no packages."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2] / "samples")]
