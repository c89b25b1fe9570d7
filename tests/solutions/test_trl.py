"""Chapter 97's losses against what TRL's own code said of the same log-probabilities.

tools/bench_dpo.py, which needs TRL, makes the table (--table) and compares with the installed TRL each time that it is run.
"""

import json
from pathlib import Path

import pytest
import torch

from solutions.ch97 import dpo_loss, ipo_loss

CASES = json.loads(Path(__file__).with_name("trl_dpo.json").read_text())["cases"]


def cases(loss_type):
    return [case for case in CASES if case["loss_type"] == loss_type]


@pytest.mark.parametrize("loss_type", ["sigmoid", "aot"])  # of single pairs, TRL's "aot" is DPO with label_smoothing
def test_dpo_is_what_trl_computes(loss_type):
    for case in cases(loss_type):
        logps = torch.tensor(case["logps"], dtype=torch.float64)
        losses, _, _ = dpo_loss(*logps.split(1), beta=case["beta"], label_smoothing=case["label_smoothing"])
        assert losses.item() == pytest.approx(case["loss"], abs=1e-6, rel=1e-9), case


def test_ipo_of_mean_log_probabilities_is_what_trl_computes():
    for case in cases("ipo"):
        means = torch.tensor(case["logps"], dtype=torch.float64) / torch.tensor(case["lengths"] * 2)
        assert ipo_loss(*means.split(1), beta=case["beta"]).item() == pytest.approx(case["loss"], abs=1e-6, rel=1e-9), case


def test_the_table_has_every_kind_and_extremes():
    assert {(case["loss_type"], case["label_smoothing"] > 0) for case in CASES} == {
        ("sigmoid", False),
        ("aot", True),
        ("ipo", False),
    }
    assert max(case["loss"] for case in cases("sigmoid")) > 100
