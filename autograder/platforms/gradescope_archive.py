"""The archive for Gradescope's own container: it grades one submission at a time, there, when it is handed in.

Gradescope unpacks the archive to `/autograder/source`, runs `setup.sh` once when the image is built, and `run_autograder` for each
submission. The hidden checks and solutions lie in the same container as the learner's code, and only the sandbox stands between them.
Where bubblewrap is not allowed to start, `run_autograder` refuses: Gradescope then shows that the autograder failed, and gives no points.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

from autograder.paths import checkout

FOLDERS = {"autograder": "*.py", "solutions": "*.py", "experiments": "*.py", "course_lib": "*", "chapters": "*.md"}
FILES = ("requirements.txt", "constraints.txt", "pyproject.toml", "README.md", "book/references.bib")
ATLAS = "experiments/atlas/records"  # checks say whose rule an answer follows
_DATE = (1980, 1, 1, 0, 0, 0)  # the same bytes for the same course

_SETUP = """\
#!/usr/bin/env bash
# Runs once, when Gradescope builds the image. Choose Ubuntu 24.04: the course needs Python 3.11, 3.12 or 3.13.
set -euo pipefail
root=${AUTOGRADER_ROOT:-/autograder}
apt-get update
DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends bubblewrap util-linux python3 python3-venv
python3 -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13) and "Choose an image with Python 3.11 to 3.13.")'
python3 -m venv "$root/venv"
"$root/venv/bin/pip" install --no-cache-dir -r "$root/source/requirements.txt"
"$root/venv/bin/pip" install --no-cache-dir --no-deps -e "$root/source"
"""

_RUN = """\
#!/usr/bin/env bash
# Runs for each submission. Without a result, Gradescope says that the autograder failed, and gives no points.
root=${{AUTOGRADER_ROOT:-/autograder}}
cd "$root/source" || exit 1
exec "${{AUTOGRADER_PYTHON:-$root/venv/bin/python}}" -m autograder.platforms.gradescope_container {assignment} "$root"{flag}
"""


def archive(assignment: str, trusted: bool = False) -> bytes:
    """The zip for one assignment. `trusted`: grade without a sandbox where none starts, which only one's own code should be.

    Raises: FileNotFoundError without a checkout of the project.
    """
    root = checkout()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as target:
        run = _RUN.format(assignment=assignment, flag=" --trust-submissions" if trusted else "")
        for name, text in (("setup.sh", _SETUP), ("run_autograder", run)):
            _add(target, name, text.encode(), 0o755)
        for path in sorted(_sources(root)):
            _add(target, path.relative_to(root).as_posix(), path.read_bytes(), 0o644)
    return stream.getvalue()


def _sources(root: Path) -> Iterator[Path]:
    for folder, pattern in FOLDERS.items():
        for path in (root / folder).rglob(pattern):
            inside = path.relative_to(root).parts
            if path.is_file() and not path.is_symlink() and not {"__pycache__", "frozen"} & set(inside):
                yield path
    yield from (root / name for name in FILES if (root / name).is_file())
    yield from (root / ATLAS).glob("*.json")


def _add(target: zipfile.ZipFile, name: str, data: bytes, mode: int) -> None:
    info = zipfile.ZipInfo(name, _DATE)
    info.external_attr = (0o100000 | mode) << 16
    info.compress_type = zipfile.ZIP_DEFLATED
    target.writestr(info, data)
