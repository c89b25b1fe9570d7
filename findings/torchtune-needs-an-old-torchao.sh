#!/usr/bin/env bash
# torchtune 0.6.1, its last release, installs without torchao and imports with no torchao of today: `pip install torchtune torchao` is
# resolved without a complaint, and then `import torchtune` raises ModuleNotFoundError, since torchao has moved a module that it takes
# from there. With torchao 0.10.0 of the same months it works.
#
# Why: its metadata asks for no torchao at all, neither a version nor the package, so no resolver can know.
#
# Seen in November 2026 with torch 2.13.0: torchao 0.10.0 imports, 0.18.0 does not, for want of torchao.dtypes.nf4tensor.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
python="$folder/venv/bin/python"
install() { "$python" -m pip install --quiet --disable-pip-version-check "$@"; }
install torch==2.13.0 numpy==2.4.6 torchtune==0.6.1
cd "$folder"
"$python" - <<'PYTHON'
from importlib import metadata

asked = [one for one in metadata.requires("torchtune") if one.startswith("torchao")]
print("what torchtune asks of torchao:", asked)
assert not asked, "this is no longer so"
PYTHON
for version in 0.10.0 0.18.0; do
  install "torchao==$version"
  PYTHONWARNINGS=ignore "$python" - "$version" <<'PYTHON'
import sys

try:
    import torchtune  # noqa: F401

    found = "imports"
except ModuleNotFoundError as error:
    found = f"no module named {error.name}"
print(f"torchao {sys.argv[1]}: torchtune 0.6.1 {found}")
assert found == ("imports" if sys.argv[1] == "0.10.0" else "no module named torchao.dtypes.nf4tensor"), "this is no longer so"
PYTHON
done
