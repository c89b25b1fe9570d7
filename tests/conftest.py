"""What every test may rely on: the programs of this environment (alembic, which nbgrader calls by name) come first on PATH."""

import os
import sys
from pathlib import Path

os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
