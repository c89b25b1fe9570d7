#!/usr/bin/env bash
# `@settings(derandomize=True)` promises the same examples in every run of a test. With hypothesis 6.170.15 they also depend on what else the
# process has imported: numbers that stand in the source of local modules are tried as inputs, so that a test which passes alone, or in one
# worker of pytest-xdist, draws other numbers beside another test's modules, and may fail there.
#
# Why: constants are collected from those of sys.modules that are neither installed nor of the standard library; an import adds some.
#
# Seen in November 2026: two runs of one process agree in all of 300 draws; once a module of two constants that nothing uses is imported, the
# draws are others, and again agree among themselves.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check hypothesis==6.170.15
mkdir "$folder/project"
cat >"$folder/project/draws.py" <<'PYTHON'
import hashlib
import sys

from hypothesis import given, settings
from hypothesis import strategies as st

if sys.argv[1:] == ["beside"]:
    import neighbour  # noqa: F401

seen = []


@settings(max_examples=300, derandomize=True, database=None, deadline=None)
@given(st.integers(0, 2**64))
def draw(number):
    seen.append(number)


draw()
print(hashlib.sha256(repr(seen).encode()).hexdigest()[:12])
PYTHON
echo "LIMITS = (8675309001, 8675309002)" >"$folder/project/neighbour.py"

draws() { (cd "$folder/project" && ../venv/bin/python draws.py "$@"); }

alone=$(draws) again=$(draws) beside=$(draws beside) beside_again=$(draws beside)
echo "draws alone: $alone, $again; beside a module that nothing uses: $beside, $beside_again"
[ "$alone" = "$again" ] && [ "$beside" = "$beside_again" ] && [ "$alone" != "$beside" ]
