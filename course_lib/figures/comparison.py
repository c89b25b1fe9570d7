"""Two clips side by side, a person who says which is better, and the reward that follows from the answers so far.

In a live notebook the person is you: three buttons, and the reward is fitted again after each answer. When the book is built
(environment variable COURSE_BOOK=1) a simulated person answers, and the page gets a recording of that session to step through: one
self-contained piece of HTML that needs no kernel and no network.
"""

from __future__ import annotations

import base64
import html
import io
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.resources import files

import numpy as np
import torch

from course_lib.control.tasks import PendulumVectorEnv

STATIC = files("course_lib") / "static"
ANSWERS = {"left": "Left is better", "right": "Right is better", "equal": "Equally good"}
STEPS = 40  # of a clip: two seconds
ANGLES = np.linspace(-180, 180, 37)  # where the learned reward is shown, in degrees from upright
HELD_OUT = 400  # pairs that nobody is asked about


def features(angle, velocity) -> torch.Tensor:
    """What the reward is linear in: cos θ, sin θ, cos 2θ and the squared velocity, scaled to about 1; (..., 4)."""
    angle, velocity = (torch.as_tensor(given, dtype=torch.float64) for given in (angle, velocity))
    return torch.stack([angle.cos(), angle.sin(), (2 * angle).cos(), (velocity / 8).square()], dim=-1)


@dataclass
class Session:
    """Pairs of clips of a pendulum, the answers given so far, and the linear reward that explains them.

    Args:
      loss: `loss(chosen_returns, rejected_returns) -> scalar`, such as your bradley_terry_loss.
      pairs: how many there are to compare.
      seed: of the clips.
      ridge: weight of the penalty Σ w² that keeps the reward finite while a few answers can be explained perfectly.
    """

    loss: Callable
    pairs: int = 20
    seed: int = 0
    ridge: float = 0.02
    answers: list[str] = field(default_factory=list)

    def __post_init__(self):
        envs = PendulumVectorEnv(2 * (self.pairs + HELD_OUT), time_limit=STEPS + 1)
        envs.reset(seed=self.seed)
        rng = np.random.default_rng(self.seed)
        torque = rng.uniform(-2, 2, (envs.num_envs, 1))
        states, rewards = [], []
        for _ in range(STEPS):
            torque = np.where(rng.random(torque.shape) < 0.1, rng.uniform(-2, 2, torque.shape), torque)
            states.append(envs.states)
            rewards.append(envs.step(torque)[1])
        self.states = np.stack(states, axis=1)  # (clips, STEPS, 2): angle and velocity
        self.true_returns = torch.as_tensor(
            np.sum(rewards, axis=0)
        )  # by Pendulum's own reward, which only a simulated person knows
        self.sums = features(self.states[..., 0], self.states[..., 1]).sum(1)  # (clips, 4)
        self.weights = torch.zeros(4, dtype=torch.float64)

    def answer(self, given: str) -> None:
        """Take an answer ("left", "right" or "equal") to the next pair, and fit the reward to all answers again."""
        if given not in ANSWERS:
            raise ValueError(f"given must be one of {', '.join(ANSWERS)}, got {given!r}")
        self.answers.append(given)
        chosen, rejected = [], []
        for pair, said in enumerate(self.answers):  # a tie counts as half an answer each way: both, beside two of every other
            left, right = self.sums[2 * pair], self.sums[2 * pair + 1]
            ordered = {"left": [(left, right)] * 2, "right": [(right, left)] * 2, "equal": [(left, right), (right, left)]}
            for better, worse in ordered[said]:
                chosen.append(better)
                rejected.append(worse)
        better, worse = torch.stack(chosen), torch.stack(rejected)
        weights = self.weights.clone().requires_grad_()
        optimizer = torch.optim.LBFGS([weights], max_iter=50, line_search_fn="strong_wolfe")

        def closure():
            optimizer.zero_grad()
            value = self.loss(better @ weights, worse @ weights) + self.ridge * weights.square().sum()
            value.backward()
            return value

        optimizer.step(closure)
        self.weights = weights.detach()

    def curve(self) -> np.ndarray:
        """The learned reward of a pendulum at rest, at every angle of ANGLES, its mean taken off."""
        rewards = (features(np.deg2rad(ANGLES), np.zeros_like(ANGLES)) @ self.weights).numpy()
        return rewards - rewards.mean()

    def accuracy(self) -> float:
        """The share of held-out pairs in which the learned reward and Pendulum's own prefer the same clip; a tie is half right."""
        learned = (self.sums @ self.weights)[2 * self.pairs :].view(-1, 2)
        truth = self.true_returns[2 * self.pairs :].view(-1, 2)
        signs = (learned[:, 0] - learned[:, 1]).sign() * (truth[:, 0] - truth[:, 1]).sign()
        return ((signs + 1) / 2).mean().item()


def compare_clips(loss, person, pairs=20, seed=0) -> None:
    """Show clips of a pendulum to compare, and the reward learned from the answers.

    Args:
      loss: `loss(chosen_returns, rejected_returns) -> scalar`.
      person: `person(return_left, return_right) -> "left", "right" or "equal"` simulates the one whose session the book's page replays;
        in a live notebook nobody asks it.
      pairs: how many to compare.
      seed: of the clips.
    """
    session = Session(loss, pairs, seed)
    if os.environ.get("COURSE_BOOK") == "1":
        _show_recorded(session, person)
    else:
        _show_live(session)


def record(session: Session, person: Callable) -> dict:
    """Let a simulated person answer all pairs; what the page needs to replay the session, as plain data."""
    curves, accuracies = [session.curve()], [session.accuracy()]
    for pair in range(session.pairs):
        left, right = session.true_returns[2 * pair : 2 * pair + 2].tolist()
        session.answer(person(left, right))
        curves.append(session.curve())
        accuracies.append(session.accuracy())
    return {
        "clips": np.rad2deg(session.states[: 2 * session.pairs, :, 0]).round().astype(int).reshape(-1, 2, STEPS).tolist(),
        "texts": [[description(clip) for clip in session.states[2 * pair : 2 * pair + 2]] for pair in range(session.pairs)],
        "answers": [ANSWERS[given] for given in session.answers],
        "chosen": list(session.answers),
        "angles": ANGLES.astype(int).tolist(),
        "curves": [[round(value, 3) for value in curve.tolist()] for curve in curves],
        "accuracies": [round(value, 3) for value in accuracies],
    }


def description(clip) -> str:
    """A clip in words, for those who cannot see it: (STEPS, 2) angles and velocities."""

    def place(angle):
        offset = round(math.degrees((angle + math.pi) % (2 * math.pi) - math.pi))
        side = "left" if offset > 0 else "right"
        return "upright" if abs(offset) < 8 else "hanging" if abs(offset) > 172 else f"{abs(offset)}° to the {side} of upright"

    turned = math.degrees(np.abs(np.diff(clip[:, 0])).sum())
    return f"from {place(clip[0, 0])} to {place(clip[-1, 0])}, turning through {turned:.0f}° on the way"


def to_html(data: dict, title: str) -> str:
    """The recorded session as a self-contained figure."""
    pairs = len(data["answers"])
    payload = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    clips = "".join(
        f'<div class="clip"><p>{side}</p><svg role="img" viewBox="0 0 200 200" aria-label="{side} clip"></svg>'
        f'<p class="words"></p></div>'
        for side in ("Left", "Right")
    )
    columns = "".join(f'<th scope="col">{angle}°</th>' for angle in data["angles"][::3])
    return (
        f'<figure class="comparison"><style>{_static("comparison.css")}</style><figcaption>{html.escape(title)}</figcaption>'
        f'<div class="controls"><label>answers given <input type="range" min="0" max="{pairs}" step="1" value="{pairs}">'
        f'<output>{pairs}</output></label><button type="button">Play both clips</button></div>'
        f'<div class="clips">{clips}</div><p class="answer" role="status"></p>'
        f'<p class="panel">Learned reward of a pendulum at rest, in log-odds a step, against its angle from upright</p>'
        f'<div><svg class="curve" role="img" aria-label="learned reward"></svg></div>'
        f"<details><summary>The curve as a table</summary>"
        f'<div class="scroll" tabindex="0" role="region" aria-label="The curve as a table"><table><thead><tr>'
        f'<th scope="col">angle</th>{columns}</tr></thead><tbody><tr><th scope="row">learned reward</th>'
        f"{'<td></td>' * len(data['angles'][::3])}</tr></tbody></table></div></details>"
        f'<script type="application/json">{payload}</script><script>{_static("comparison.js")}</script></figure>'
    )


def animation(clip, label: str) -> str:
    """A clip as an SVG that moves by itself, without end: (STEPS, 2) angles and velocities."""
    turns = ";".join(f"{-angle:.0f} 100 100" for angle in np.rad2deg(clip[:, 0]))
    return (
        f'<svg viewBox="0 0 200 200" width="200" role="img" aria-label="{label}: {description(clip)}">'
        f'<circle cx="100" cy="100" r="92" fill="none" stroke="#686d72" opacity="0.3"/>'
        f'<g stroke="#2a7fbf" fill="#2a7fbf"><g><line x1="100" y1="100" x2="100" y2="28" stroke-width="8" stroke-linecap="round"/>'
        f'<circle cx="100" cy="28" r="10"/><animateTransform attributeName="transform" type="rotate" calcMode="discrete" '
        f'values="{turns}" dur="{STEPS * 0.05}s" repeatCount="indefinite"/></g></g><circle cx="100" cy="100" r="5" fill="#686d72"/></svg>'
    )


def _static(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")


def _draw(ax, session: Session) -> None:
    ax.plot(ANGLES, session.curve())
    ax.set(
        xlabel="angle from upright, in degrees",
        ylabel="learned reward",
        title=f"after {len(session.answers)} answers",
        xticks=range(-180, 181, 60),
    )


def _show_live(session: Session) -> None:
    import ipywidgets as widgets
    import matplotlib.pyplot as plt
    from IPython.display import display

    left, right, plot = widgets.HTML(), widgets.HTML(), widgets.Output()
    status = widgets.HTML()
    buttons = {given: widgets.Button(description=label) for given, label in ANSWERS.items()}

    def show() -> None:
        pair = len(session.answers)
        if pair < session.pairs:
            left.value, right.value = (
                animation(session.states[2 * pair + side], label) for side, label in enumerate(("left", "right"))
            )
            status.value = f"Pair {pair + 1} of {session.pairs}: which one do you prefer?"
        else:
            status.value = "That was the last pair. Run the cell again to begin anew."
            for button in buttons.values():
                button.disabled = True
        with plot:
            plot.clear_output(wait=True)
            _, ax = plt.subplots(figsize=(6, 2.6))
            _draw(ax, session)
            plt.show()

    def take(given: str) -> None:
        session.answer(given)
        show()

    for given, button in buttons.items():
        button.on_click(lambda _, given=given: take(given))
    show()
    display(widgets.VBox([widgets.HBox([left, right]), status, widgets.HBox(list(buttons.values())), plot]))


def _show_recorded(session: Session, person: Callable) -> None:
    """The HTML for the book; for readers without it, a picture of the last reward and a sentence."""
    import matplotlib.pyplot as plt
    from IPython.display import display

    data = record(session, person)
    title = f"A simulated person compares {session.pairs} pairs of clips, and a reward learns from the answers"
    figure, ax = plt.subplots(figsize=(6, 2.6))
    _draw(ax, session)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=100, facecolor="white")
    plt.close(figure)
    display(
        {
            "text/html": to_html(data, title),
            "image/png": base64.b64encode(picture.getvalue()).decode(),
            "text/plain": f"{title}; it then foresees {data['accuracies'][-1]:.0%} of {HELD_OUT} other comparisons",
        },
        raw=True,
    )
