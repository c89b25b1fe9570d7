"""A folder with one quick experiment, which can be told to fail, to stop half-way and to count how often its steps are taken."""

import pytest

TOY = '''"""A toy: counts to a number.

More words.
"""

import time

from experiments import checkpoint
from experiments.campaign import Result

VARIANTS = {"fast": {"steps": 3}, "slow": {"steps": 40, "pause": 0.05}}
SEEDS = {"fast": 2, "slow": 1}


def run(variant, seed, checkpoint_dir, report):
    configuration = VARIANTS[variant]
    if (checkpoint_dir.parents[3] / "fail").exists() and seed == 1:
        raise RuntimeError("told to fail")
    rows = (checkpoint.load(checkpoint_dir) or {"rows": []})["rows"]
    for step in range(len(rows), configuration["steps"]):
        time.sleep(configuration.get("pause", 0))
        with (checkpoint_dir.parents[3] / "steps.txt").open("a") as log:
            log.write(f"{variant}-{seed}-{step}\\n")
        rows.append({"env_steps": step, "score": float(seed + step)})
        checkpoint.save(checkpoint_dir, {"rows": rows})
        report(step + 1, configuration["steps"])
    return Result(rows, {"last": rows[-1]["score"]}, {"txt": b"artefact"})
'''


@pytest.fixture
def folder(tmp_path):
    """Holds toy.py; records go into `folder / "runs"`."""
    (tmp_path / "toy.py").write_text(TOY)
    return tmp_path


@pytest.fixture(autouse=True)
def _forget_the_toy():
    """Tests change the toy: none sees another's."""
    import sys

    yield
    sys.modules.pop("experiments.toy", None)
