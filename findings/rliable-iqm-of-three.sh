#!/usr/bin/env bash
# rliable's interquartile mean of three runs is their mean: with 1.2.0 `metrics.aggregate_iqm` of one task and three seeds leaves nothing
# out, so that one lucky seed moves it as it moves a mean, and the interval of the one is the interval of the other. With five seeds it is the
# mean of the middle three, not of the middle half.
#
# Why: it is scipy's `trim_mean` with a quarter to cut from each end, and the number of runs to cut is rounded down: a quarter of three is none.
# Scores of several tasks are put into one list first, so that three seeds are enough where there are two tasks or more.
#
# Seen in November 2026: scores 1, 2, 30: 11 and 11. Scores 0, 0, 0, 0, 100: 0 and 20; 1, 2, 3, 10, 100: 5, where the middle half is 4.8.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check rliable==1.2.0 arch==7.2.0 pandas==2.3.3 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - <<'PYTHON'
import numpy as np
from rliable import library, metrics


def both(scores):
    return np.array([metrics.aggregate_iqm(scores), metrics.aggregate_mean(scores)])


three = np.array([[1.0], [2.0], [30.0]])  # (runs, tasks)
points, intervals = library.get_interval_estimates({"ours": three}, both, reps=2000)
print("three seeds:", *points["ours"], "intervals", intervals["ours"].T.tolist())
assert points["ours"].tolist() == [11, 11], "this is no longer so"
assert intervals["ours"].T.tolist() == [[1, 30], [1, 30]]

five = np.array([1.0, 2.0, 3.0, 10.0, 100.0])
half = (0.75 * five[1] + five[2] + 0.75 * five[3]) / 2.5  # a quarter of five runs is 1.25: a quarter of the second and of the fourth go, too
print("five seeds:", metrics.aggregate_iqm(five[:, None]), f"the middle half: {half:.1f}")
assert metrics.aggregate_iqm(five[:, None]) == 5
PYTHON
