#!/usr/bin/env bash
# rliable 1.2.0, the usual tool for intervals over seeds, installs today without complaint and does not import: it asks for arch below 8
# and for any pandas, pip brings arch 7.2.0 and pandas 3.1.1, and arch 7.2.0 calls `deprecate_kwarg` of pandas as pandas 2 had it.
# `pip check` is content. With pandas below 3 it imports.
#
# Seen in November 2026: TypeError: deprecate_kwarg() missing 1 required positional argument: 'new_arg_name'.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip() { "$folder/venv/bin/python" -m pip --disable-pip-version-check "$@"; }
pip install --quiet rliable==1.2.0 arch==7.2.0 pandas==3.1.1 numpy==2.4.6 scipy==1.17.1
pip check
cd "$folder"
if said=$(venv/bin/python -c "import rliable.library" 2>&1); then
    echo "this is no longer so: it imports"
    exit 1
fi
tail -n 1 <<<"$said"
grep -q "deprecate_kwarg() missing 1 required positional argument" <<<"$said"
pip install --quiet pandas==2.3.3
venv/bin/python -c "import rliable.library; print('with pandas 2.3.3 it imports')"
