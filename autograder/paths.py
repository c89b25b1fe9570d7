"""Where things lie in a checkout of the project: the one place that knows the layout."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CHAPTERS = ROOT / "chapters"
COURSE_LIB = ROOT / "course_lib"
RUNS = ROOT / "experiments" / "runs"
BIBLIOGRAPHY = ROOT / "book" / "references.bib"


def checkout(root: Path = ROOT) -> Path:
    """The checkout's root; FileNotFoundError if the package was installed away from its chapters."""
    if not (root / "chapters").is_dir():
        raise FileNotFoundError(
            f"no chapters/ in {root}: the course's commands need a checkout of the whole project;"
            " install it in place with `pip install -e .` or run from the checkout's root"
        )
    return root
