"""Where the thresholds of an exercise that is judged by a file come from: agents trained rightly and wrongly, and how they flew.

Where settings are judged, an agent is a set of as many trainings with them as the judge makes, and an episode is one training.

The bar: of right agents, at most one in a hundred earns less than all points; of those with a mistake that a flight must show
(`Artefact.wrong`), none earns half of them, and of further ones at most one in twenty, which is as much as five agents can show.
Other mistakes let an agent land all the same: only the checks of functions find those, and the table says how often they land. A
student's luck is the seed of a training, since the judge's episodes are the same for all; the recorded ones begin from other
seeds. Twenty agents cannot show a hundredth by counting, so the chance that a further agent crosses a mark is taken to be the
larger of two estimates:

- bootstrap: draw one of the agents, and as many of its episodes as the judge flies, with replacement; how often does the mean cross?
  It keeps the shape of what was seen, and counts the luck of the episodes as if the judge drew new ones;
- prediction: a further agent's mean return, if those of agents are normal, is mean + deviation √(1 + 1/n) t with n - 1 degrees of
  freedom. It counts the luck of the trainings, beyond the worst that was seen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autograder.authoring.spec import Artefact, Tuning
from course_lib.figures import records

BAR, BAR_WRONG = 0.01, 0.05
DRAWS = 200_000


@dataclass(frozen=True)
class Group:
    """Agents that were trained alike: their returns, (agents, episodes). `mistake` is empty if rightly."""

    variant: str
    mistake: str
    returns: np.ndarray


@dataclass(frozen=True)
class Row:
    """A group as the book prints it: the agents' mean returns (least, middle, most), how many earn all points and how many half of
    them, and the chance that a further agent goes wrong: that a right one earns less than all, a wrong one half or more."""

    variant: str
    mistake: str
    agents: int
    least: float
    middle: float
    most: float
    full: int
    half: int
    chance: float


def groups(artefact: Artefact | Tuning, runs: Path | None = None) -> list[Group]:
    """The agents of the artefact's experiment that were trained for this, with the returns of their recorded evaluation.

    Args:
      artefact: its `experiment` has a variant `right`, and others with a `mistake` in their configurations.
      runs: the folder of all experiments' records; found by itself if not given.

    Raises: records.RecordsError if runs are missing.
    """
    known = records.load(artefact.experiment, runs)
    mistakes = {variant: known.configuration(variant).get("mistake", "") for variant in known.variants}
    wanted = {variant: mistake for variant, mistake in mistakes.items() if mistake or variant == artefact.right}
    found = [Group(variant, mistake, known.summary(variant, "eval_returns")) for variant, mistake in wanted.items()]
    return sorted(found, key=lambda group: (bool(group.mistake), group.variant not in artefact.wrong))


def rows(artefact: Artefact | Tuning, found: Sequence[Group]) -> list[Row]:
    """What the groups say about the artefact's thresholds."""
    low, high = artefact.thresholds
    half, result = (low + high) / 2, []
    for group in found:
        means = group.returns.mean(axis=1)
        chance = chance_from(group.returns, half) if group.mistake else chance_below(group.returns, high)
        spread = (float(means.min()), float(np.median(means)), float(means.max()))
        counts = (int((means >= high).sum()), int((means >= half).sum()))
        result.append(Row(group.variant, group.mistake, len(means), *spread, *counts, chance))
    return result


def printed(artefact: Artefact | Tuning) -> dict[str, Any]:
    """The rows as the book prints them, as plain data."""
    return {
        "exercise": artefact.name,
        "thresholds": list(artefact.thresholds),
        "episodes": artefact.episodes,
        "wrong": list(artefact.wrong),
        "of": "trainings" if isinstance(artefact, Tuning) else "episodes",
        "agents": [asdict(row) for row in rows(artefact, groups(artefact))],
    }


def report(row: Mapping[str, Any], right: str) -> list[str]:
    """Where the agents behind an exercise's thresholds miss the bar; `right` is the variant that was trained rightly."""
    lines = []
    for agents in row["agents"]:
        name, chance = f"{row['exercise']}: agents {agents['variant']!r}", f"{agents['chance']:.1%}"
        if agents["variant"] == right and (agents["full"] < agents["agents"] or agents["chance"] > BAR):
            lines.append(
                f"{name}: {agents['full']} of {agents['agents']} earn all points, and a further one less by a chance of {chance}"
            )
        if agents["variant"] in row["wrong"] and (agents["half"] or agents["chance"] > BAR_WRONG):
            lines.append(f"{name}: {agents['half']} of {agents['agents']} earn half, and a further one by a chance of {chance}")
    return lines


def chance_below(returns: np.ndarray, mark: float, seed: int = 0) -> float:
    """The chance that the mean return of a further agent is below `mark`.

    Args:
      returns: of agents that were trained alike, in the same episodes; (agents, episodes), at least three agents.
      mark: in units of return.
      seed: of the random draws.

    Returns: the larger of the two estimates that the module describes.
    """
    agents, episodes = returns.shape
    if agents < 3:
        raise ValueError(f"returns must be of at least 3 agents, got {agents}")
    generator = np.random.default_rng(seed)
    means = returns.mean(axis=1)
    # the mean of many episodes drawn with replacement is normal, but for what no table of two digits shows
    drawn = generator.integers(agents, size=DRAWS)
    resampled = means[drawn] + returns.std(axis=1)[drawn] / math.sqrt(episodes) * generator.standard_normal(DRAWS)
    further = means.mean() + means.std(ddof=1) * math.sqrt(1 + 1 / agents) * generator.standard_t(agents - 1, DRAWS)
    return float(max((resampled < mark).mean(), (further < mark).mean()))


def chance_from(returns: np.ndarray, mark: float, seed: int = 0) -> float:
    """The chance that the mean return of a further agent is `mark` or more; as `chance_below`."""
    return chance_below(-returns, -mark, seed)
