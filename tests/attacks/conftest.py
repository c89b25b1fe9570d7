"""Attacks import each other's toolbox as `tests.attacks.toolbox`, from wherever pytest is started."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
