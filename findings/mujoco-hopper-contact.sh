#!/usr/bin/env bash
# A version of MuJoCo is part of a result: the same model under the same controls moves otherwise in 3.5.0 than in 3.3.7, from the first
# contact on. Until then the two agree in every bit.
#
# Why: what changed lies in the contacts alone, so that tests of a body in the air see nothing of it.
#
# Seen in November 2026 with Gymnasium 1.4.0's hopper.xml, which is one file for both: 300 steps under small controls agree until the foot
# touches the floor, in step 42 (counted from 0), where the positions jump apart by 7e-5, and end 1e-3 apart, the hopper in one version
# standing a millimetre higher.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat >"$folder/fall.py" <<'PYTHON'
import importlib.util
import json
import sys
from pathlib import Path

import mujoco
import numpy as np

gymnasium = importlib.util.find_spec("gymnasium").submodule_search_locations[0]
model = mujoco.MjModel.from_xml_path(str(Path(gymnasium, "envs", "mujoco", "assets", "hopper.xml")))
data = mujoco.MjData(model)
seen = []
for step in range(300):
    data.ctrl[:] = 0.1 * np.sin(0.05 * step * np.arange(1, 4))
    mujoco.mj_step(model, data)
    seen.append([data.ncon, data.qpos.tolist()])
Path(sys.argv[1]).write_text(json.dumps(seen))
PYTHON
for version in 3.3.7 3.5.0; do
    python3 -m venv --clear "$folder/venv"
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check mujoco==$version numpy==2.4.6
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps gymnasium==1.4.0
    "$folder/venv/bin/python" "$folder/fall.py" "$folder/$version.json"
done
python3 - "$folder" <<'PYTHON'
import json
import sys
from pathlib import Path

older, newer = (json.loads(Path(sys.argv[1], f"{version}.json").read_text()) for version in ("3.3.7", "3.5.0"))
apart = [max(abs(a - b) for a, b in zip(one[1], other[1], strict=True)) for one, other in zip(older, newer, strict=True)]
touching = next(step for step, (contacts, _) in enumerate(newer) if contacts)
parting = next(step for step, distance in enumerate(apart) if distance)
print(f"first contact in step {touching}; first difference in step {parting}: {apart[parting]:.1e}; at the end {apart[-1]:.1e}")
assert touching == parting == 42 and 1e-5 < apart[parting] < 1e-3 and 5e-4 < apart[-1] < 2e-3, "this is no longer so"
PYTHON
