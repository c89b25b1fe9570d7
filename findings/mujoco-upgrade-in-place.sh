#!/usr/bin/env bash
# MuJoCo 4 is three packages where MuJoCo 3 was one. Upgrading in place leaves an environment in which `import mujoco` fails,
# while pip ends with "Successfully installed" and `pip check` finds nothing wrong.
#
# Why: mujoco-core is new, so pip unpacks it before it uninstalls mujoco 3, whose list of files names the same paths: the new
# core's bindings go with the old package.
#
# Seen in November 2026 with mujoco 3.3.7 -> 4.0.0 and pip 24 on Linux, CPython 3.11: the import raises ImportError and names the
# mend, a reinstallation of all three packages. A fresh environment is not affected.
# Fails (exit 1) if any of this is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip=("$folder/venv/bin/python" -m pip --disable-pip-version-check)

"${pip[@]}" install --quiet mujoco==3.3.7
"$folder/venv/bin/python" -c 'import mujoco; assert mujoco.__version__ == "3.3.7"'
"${pip[@]}" install --quiet mujoco==4.0.0
echo "pip check: $("${pip[@]}" check)"
if "$folder/venv/bin/python" -c 'import mujoco' 2>"$folder/said"; then
    echo "import mujoco works after the upgrade: this is no longer so" >&2
    exit 1
fi
tail -n 3 "$folder/said"
grep -q "ImportError" "$folder/said"

"${pip[@]}" install --quiet --force-reinstall --no-deps mujoco==4.0.0 mujoco-core==4.0.0 mujoco-studio==4.0.0
"$folder/venv/bin/python" -c 'import mujoco; print("after reinstalling all three:", mujoco.__version__)'
