#!/usr/bin/env bash
# reasoning-gym pays a wrong number that has the right one in it, and pays it more than the right number written otherwise: with 0.1.25,
# where the answer is 12, "412", "-12" and "120" earn 0.667 each, "12.0" 0.5 and "13" 0. In a group of answers to one question (GRPO) "12.0"
# may be pushed down and "412" up, and a mean score is no share of right answers: a model that always writes a nought too many seems half
# right.
#
# Why: 33 of the 106 tasks keep the scoring that they inherit. It looks for the right answer as text within the given one, and pays the length
# of the first over that of the second, so that words around an answer cost a little; a digit beside it is taken for such words.
#
# Seen in November 2026, 500 questions each of greatest common divisors, primes to be counted, equations and legs: mean score of the right
# answer with ".0" 0.35 to 0.59; of ten times the right answer, of its negative, of it with a 4 before it 0.52 to 0.74 each; of the right
# answer plus one 0.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check reasoning-gym==0.1.25
cd "$folder"
venv/bin/python - <<'PYTHON'
import reasoning_gym
from reasoning_gym.dataset import ProceduralDataset
from reasoning_gym.factory import DATASETS

WRITTEN = {
    "right": lambda right: right,
    "with .0": lambda right: f"{right}.0",
    "4 before it": lambda right: f"4{right}",
    "negative": lambda right: f"-{right}",
    "tenfold": lambda right: f"{right}0",
    "plus one": lambda right: f"{int(right) + 1}",
}
inherited = sum(kind.score_answer is ProceduralDataset.score_answer for kind, _ in DATASETS.values())
print(f"{inherited} of {len(DATASETS)} tasks keep the inherited scoring")
print(f"{'mean score':18s}", *(f"{name:>12s}" for name in WRITTEN))
for name in ("gcd", "count_primes", "simple_equations", "leg_counting"):
    task = reasoning_gym.create_dataset(name, size=500, seed=0)
    entries = [entry for entry in task if int(entry["answer"]) > 0]
    means = {way: sum(task.score_answer(write(entry["answer"]), entry) for entry in entries) / len(entries) for way, write in WRITTEN.items()}
    print(f"{name:18s}", *(f"{mean:12.2f}" for mean in means.values()))
    assert means["right"] == 1
    assert min(means["4 before it"], means["negative"], means["tenfold"]) > max(means["with .0"], 0.5), "this is no longer so"
    assert means["plus one"] < 0.01

task = reasoning_gym.create_dataset("gcd", size=500, seed=0)
entry = next(entry for entry in task if entry["answer"] == "12")
scores = {said: round(task.score_answer(said, entry), 3) for said in ("12", "12.0", "412", "-12", "120", "13")}
print("where the answer is 12:", scores)
assert scores == {"12": 1.0, "12.0": 0.5, "412": 0.667, "-12": 0.667, "120": 0.667, "13": 0.0}
assert (inherited, len(DATASETS)) == (33, 106)
PYTHON
