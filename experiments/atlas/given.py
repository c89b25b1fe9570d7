"""The one input that every library of the atlas is given, what the course makes of it, and the rules that libraries follow instead.

Nothing here is a result that was typed in: `formulas()` computes the course's numbers from its references when it is called, and so it
does with each rule that a library is known to follow where it parts from them. A library's script (experiments/atlas/libraries) says
only which formula it computed and the numbers it got; experiments/atlas/comparing.py finds the rule that made them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import torch
from torch.nn import functional

from course_lib.control import sac
from solutions import ch43, ch44, ch45, ch47, ch74, ch80, ch95, ch96, ch97

TOLERANCE = 1e-6
"""Of a difference between two numbers, and of its ratio to the largest number of a row where that is above 1."""

GIVEN: dict[str, Any] = {
    # A rollout, [environment][step]; environment 1 is terminated and truncated at step 3, and both go on after step 7.
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "rewards": [[1.0, 0.0, 2.0, -0.5, 0.75, 1.25, -1.0, 0.5], [0.5, -1.0, 0.25, 1.5, 0.0, -0.75, 2.0, 1.0]],
    "values": [[0.2, 0.4, -0.6, 1.5, 0.9, 0.3, -0.8, 0.6], [1.1, -0.3, 0.8, 0.1, -1.2, 0.7, 1.4, -0.5]],
    "terminated": [[0, 0, 1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0]],
    "truncated": [[0, 0, 0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0, 1, 0]],
    "final_values": [
        [0, 0, 3.0, 0, 0, 10.0, 0, 0],
        [0, 0, 0, 4.0, 0, 0, -2.0, 0],
    ],  # of the true last observation, at an end only
    "last_values": [0.35, -0.15],  # of the observation after step 7
    # A minibatch.
    "clip_range": 0.2,
    "logp": [-1.0, -0.7, -2.3, -0.4, -1.6, -0.9],
    "old_logp": [-1.2, -0.6, -1.5, -1.1, -1.62, -0.95],
    "adv": [1.0, -0.5, 2.0, -1.5, 0.3, 0.8],
    "returns": [1.3, 0.2, -0.7, 2.4, 0.0, -1.1],
    "new_values": [1.0, 0.5, -0.2, 1.0, 0.3, -0.4],
    "old_values": [0.9, 0.1, -0.1, 0.2, 0.25, 0.3],
    "entropy": [1.2, 1.0, 0.9, 1.3, 1.1, 0.7],
    "vf_coef": 0.5,
    "ent_coef": 0.01,
    # Tokens of three completions.
    "mask": [[1, 1, 1, 0, 0], [1, 1, 1, 1, 1], [1, 1, 0, 0, 0]],
    "tok_logp": [[-1.0, -0.5, -2.0, -0.3, -0.9], [-0.7, -1.1, -0.2, -1.9, -0.4], [-2.5, -0.6, -1.0, -0.1, -0.8]],
    "tok_old": [[-1.3, -0.5, -1.4, -0.6, -0.2], [-0.6, -1.2, -0.5, -1.5, -0.45], [-2.0, -1.0, -0.3, -0.9, -1.1]],
    "tok_ref": [[-1.1, -0.9, -1.7, -0.2, -0.5], [-0.8, -1.0, -0.6, -1.3, -0.5], [-1.9, -0.8, -0.6, -0.4, -1.0]],
    "tok_values": [[0.1, 0.4, -0.2, 0.7, 0.9], [0.5, 0.3, 0.2, -0.4, 0.6], [-0.1, 0.8, 0.3, 0.2, -0.9]],
    "tok_adv": [[0.5, -1.0, 1.5, 0.0, 0.0], [-0.3, 0.9, -2.0, 0.4, 1.1], [2.0, -0.6, 0.0, 0.0, 0.0]],
    "tok_returns": [[0.6, 0.2, 0.9, 0.0, 0.0], [0.1, 1.2, -0.7, 0.3, 0.9], [1.4, 0.1, 0.0, 0.0, 0.0]],
    "tok_new_values": [[0.4, 0.3, 0.4, 0.9, 1.0], [0.0, 0.5, 0.25, 0.0, 0.3], [0.0, 0.1, 0.5, 0.3, -0.5]],
    "score": [1.5, -0.5, 0.8],
    "kl_coef": 0.05,
    "tok_gamma": 1.0,
    "tok_clip_range_vf": 0.2,
    "far_logp": math.log(5) - 1,  # one token whose ratio is 5 and whose advantage is -1
    "far_old": -1.0,
    "far_adv": -1.0,
    "k3_logp": -5.5,  # one token that the reference finds e^4.5 times as likely
    "k3_ref": -1.0,
    # Pairs of completions: sums over their tokens, and how many tokens those are.
    "beta": 0.1,
    "label_smoothing": 0.1,
    "chosen": [-20.0, -35.5, -12.0],
    "rejected": [-22.0, -30.0, -18.0],
    "ref_chosen": [-21.0, -34.0, -14.0],
    "ref_rejected": [-21.5, -32.0, -17.0],
    "chosen_lengths": [10, 14, 6],
    "rejected_lengths": [8, 12, 9],
    "simpo_gamma": 0.5,  # SimPO's target margin; the log-probabilities are taken as given
    # Scores of pairs.
    "rm_chosen": [1.2, 0.3, -0.5],
    "rm_rejected": [0.7, 0.9, -2.0],
    "margin": [0.5, 1.0, 0.0],
    "center_coef": 0.01,
    # Scores that a model gives at every token, with the padding on the right; the last kept ones are those above.
    "rm_chosen_mask": [[1, 1, 1, 0], [1, 1, 1, 1], [1, 1, 0, 0]],
    "rm_rejected_mask": [[1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]],
    "rm_chosen_tokens": [[0.1, 0.4, 1.2, 0.0], [0.2, 0.5, -0.1, 0.3], [0.7, -0.5, 0.0, 0.0]],
    "rm_rejected_tokens": [[-0.3, 0.7, 0.0, 0.0], [0.6, 0.2, 0.9, 0.0], [0.1, 0.3, -0.4, -2.0]],
    # Soft actor-critic.
    "q1": [1.0, 2.0, -0.5, 0.4],
    "q2": [0.8, 2.5, -0.2, 0.1],
    "next_logp": [-1.0, 0.5, 0.2, -0.3],
    "sac_rewards": [1.0, 0.0, -1.0, 0.5],
    "sac_terminated": [0, 1, 0, 0],
    "alpha": 0.2,
    "target_entropy": -2.0,
    # Three groups of four answers.
    "group_rewards": [[1.0, 0.0, 0.0, 1.0], [2.0, 2.0, 2.0, 2.0], [0.5, -1.0, 3.0, 0.25]],
    "lone_reward": 0.7,
    # Returns of pairs of segments: those above, and pairs whose chosen one is far worse.
    "far_gaps": [30.0, 200.0],
    # An expert's actions among three.
    "bc_logits": [[0.5, -0.3, 1.2], [0.0, 0.4, -1.0], [2.0, 0.1, 0.3], [-0.6, 0.9, 0.2]],
    "bc_actions": [2, 0, 1, 1],
}


@dataclass(frozen=True)
class Rule:
    """What a library computes in the place of the course's formula: one sentence, and the numbers."""

    name: str
    sentence: str
    numbers: Any


@dataclass(frozen=True)
class Formula:
    """One formula: where the book has it (None: nowhere, and `ours` is its usual form, written out here), and what it gives."""

    name: str
    title: str
    chapter: int | None
    ours: Any
    rules: tuple[Rule, ...] = field(default=())


def formulas() -> dict[str, Formula]:
    """All formulas by name, computed now, in double precision."""
    given = _tensors()
    parts: tuple[Callable[[SimpleNamespace], list[Formula]], ...] = (
        _rollouts,
        _minibatches,
        _sac,
        _imitation,
        _tokens,
        _scores,
        _pairs,
        _groups,
    )
    return {one.name: one for part in parts for one in part(given)}


def _tensors() -> SimpleNamespace:
    def tensor(name: str, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        numbers = torch.tensor(value, dtype=torch.float64)
        if name in ("terminated", "truncated", "sac_terminated") or name.endswith("mask"):
            return numbers.bool()
        return numbers.long() if name == "bc_actions" else numbers

    return SimpleNamespace(**{name: tensor(name, value) for name, value in GIVEN.items()})


def _formula(name: str, title: str, chapter: int | None, ours: Any, *rules: tuple[str, str, Any]) -> Formula:
    return Formula(
        name, title, chapter, plain(ours), tuple(Rule(key, sentence, plain(numbers)) for key, sentence, numbers in rules)
    )


def plain(numbers: Any) -> Any:
    """Tensors as lists and numbers."""
    return numbers.tolist() if isinstance(numbers, torch.Tensor) else numbers


# ---- rollouts: chapter 44 -------------------------------------------------------------------------------------------


def _rollouts(g: SimpleNamespace) -> list[Formula]:
    ended = g.terminated | g.truncated
    limit = g.truncated & ~g.terminated
    none = torch.zeros_like(ended)
    next_cell = torch.cat([g.values[:, 1:], g.last_values[:, None]], 1)  # the value in the next cell, of whatever episode
    true_next = torch.where(ended, g.final_values, next_cell)

    def gae(rewards=g.rewards, next_values=true_next, terminated=g.terminated, truncated=g.truncated):
        arguments = (rewards.T, g.values.T, next_values.T, terminated.T, truncated.T)
        return ch44.compute_gae(*arguments, g.gamma, g.gae_lambda).T

    def added(values, where):
        """Bootstraps that are added to rewards; every end is then taken for a termination."""
        return gae(rewards=g.rewards + g.gamma * values * where, terminated=ended)

    def ahead(targets, terminated):
        """One step ahead, to targets instead of values."""
        following = torch.cat([targets[:, 1:], g.last_values[:, None]], 1)
        return g.rewards + g.gamma * following * ~terminated - g.values

    dropped = gae(rewards=torch.where(g.truncated, g.values, g.rewards), terminated=ended)  # a step whose residual is 0
    unlimited, unbroken = gae(next_values=next_cell, truncated=none), gae(next_values=next_cell, terminated=none, truncated=none)
    first = (0, 5)  # a time limit
    return [
        _formula(
            "gae", "Generalised advantages of a rollout with time limits", 44, gae(),
            ("truncation_as_end", "A time limit counts as an end: nothing is bootstrapped there.", gae(terminated=ended)),
            ("truncation_ignored", "A time limit is not seen: the next episode's first value stands in, and the sum runs on into it.",
             gae(next_values=next_cell, truncated=none)),
            ("reset_value", "At a time limit the next episode's first value stands in; the sum stops there.", gae(next_values=next_cell)),
            ("current_value", "At a time limit γ V of the observation before the step is added, not of the one after it.",
             added(g.values, limit)),
            ("current_value_even_at_an_end",
             "At a time limit γ V of the observation before the step is added, not of the one after it, even if the task ended just then.",
             added(g.values, g.truncated)),
            ("final_value_even_at_an_end",
             "Where the task ended just at the time limit, the value of its last observation is bootstrapped.",
             added(g.final_values, g.truncated)),
            ("truncated_step_dropped",
             "A truncated step drops out (advantage 0, target V), and the others look one step ahead to the λ-return: r + γ R(t+1) - V(t).",
             ahead(g.values + dropped, g.terminated) * ~g.truncated),
        ),
        _formula(
            "stored_reward", "Reward as stored at a time limit, with its bootstrap", 44,
            (g.rewards + g.gamma * g.final_values * limit)[first],
            ("current_value", "γ V of the observation before the step is added, not of the one after it.",
             (g.rewards + g.gamma * g.values * limit)[first]),
        ),
        _formula(
            "gae_unbroken", "Generalised advantages of a rollout in which no episode ends", 44, unbroken,
            ("one_step_to_lambda_return", "One step ahead to the λ-return: r + γ R(t+1) - V(t).", ahead(g.values + unbroken, none)),
        ),
        _formula(
            "normalised_rollout", "Advantages of a rollout without its time limits, normalised over all of it", 44,
            ch44.normalize_advantages(unlimited),
            ("biased", "The standard deviation is the biased one.", _standard(unlimited, 0)),
            ("biased_with_extra_steps",
             "The standard deviation is the biased one, and steps that are put in behind each episode count, too.",
             _with_extra_steps(g, unlimited)),
            ("deviation_per_environment", "The mean is over everything, the standard deviation (unbiased) each environment's own.",
             (unlimited - unlimited.mean()) / unlimited.std(1, keepdim=True)),
        ),
        _formula("explained_variance", "Explained variance", 44, ch44.explained_variance(g.new_values, g.returns)),
    ]  # fmt: skip


def _with_extra_steps(g, advantages):
    """Normalised as though a step of reward 0 stood behind each episode, whose advantage runs on into the next one of the row."""
    extra, after = [], [(value, advantage) for value, advantage in zip(g.values.flatten(), advantages.flatten(), strict=True)]
    for n, ends in enumerate(g.terminated):
        for t in range(len(ends)):
            if not ends[t] and t < len(ends) - 1:
                continue
            own = g.final_values[n, t] if ends[t] else g.last_values[n]
            place = n * len(ends) + t + 1
            value, advantage = after[place] if place < len(after) else (0.0, 0.0)
            extra.append(g.gamma * value + g.gamma * g.gae_lambda * advantage - own)
    every = torch.cat([advantages.flatten(), torch.stack(extra)])
    return (advantages - every.mean()) / every.std(correction=0)


def _standard(x, correction):
    return (x - x.mean()) / x.std(correction=correction)


# ---- minibatches: chapters 43 to 45 ---------------------------------------------------------------------------------


def _minibatches(g: SimpleNamespace) -> list[Formula]:
    def ppo(advantages=g.adv, values=g.new_values, vf_coef=g.vf_coef, ent_coef=g.ent_coef, entropy=g.entropy):
        return ch45.ppo_loss(g.logp, g.old_logp, advantages, values, g.returns, entropy, g.clip_range, vf_coef, ent_coef)

    def policy_loss(advantages):
        return ch43.clipped_surrogate_loss(g.logp, g.old_logp, advantages, g.clip_range)

    def entropy_loss(entropy):
        return ppo(vf_coef=0, ent_coef=1, entropy=entropy)[0] - ppo(vf_coef=0, ent_coef=0)[0]

    p = g.logp.exp()
    two_actions = torch.distributions.Categorical(probs=torch.stack([p, 1 - p], -1)).entropy()
    squares = (g.new_values - g.returns) ** 2
    near = g.old_values + (g.new_values - g.old_values).clamp(-g.clip_range, g.clip_range)
    clipped = (near - g.returns) ** 2
    far = (5 * g.new_values - g.returns) ** 2
    return [
        _formula("policy_loss", "Clipped surrogate loss", 43, policy_loss(g.adv)),
        _formula(
            "policy_loss_normalised", "Clipped surrogate loss on advantages normalised in the minibatch", 45,
            policy_loss(ch44.normalize_advantages(g.adv)),
            ("biased", "The standard deviation is the biased one.", policy_loss(_standard(g.adv, 0))),
        ),
        _formula("normalised", "Advantages normalised in a minibatch", 44, ch44.normalize_advantages(g.adv),
                 ("biased", "The standard deviation is the biased one.", _standard(g.adv, 0))),
        _formula("approx_kl", "Approximate KL divergence", 43, ch43.approx_kl(g.logp, g.old_logp),
                 ("k1", "k1, the mean of old minus new log-probabilities, which may be negative.", (g.old_logp - g.logp).mean())),
        _formula(
            "clip_fraction", "Clip fraction", 43, ch43.clip_fraction(g.logp, g.old_logp, g.clip_range),
            ("silenced", "Only samples count whose gradient the clip takes away.", _silenced(g.logp, g.old_logp, g.adv, g.clip_range)),
        ),
        _formula(
            "value_loss", "Value loss", 45, ppo()[1]["value_loss"],
            ("half", "Half of the mean squared error.", squares.mean() / 2),
            ("smooth_l1", "Smooth-L1: squared errors below 1, absolute ones above.", functional.smooth_l1_loss(g.new_values, g.returns)),
        ),
        _formula(
            "value_loss_clipped", "Value loss, clipped", None, torch.maximum(squares, clipped).mean(),
            ("half", "Half of it.", torch.maximum(squares, clipped).mean() / 2),
            ("clipped_alone", "The squared error of the clipped prediction alone.", clipped.mean()),
            ("half_clipped_alone", "Half the squared error of the clipped prediction alone.", clipped.mean() / 2),
        ),
        _formula(
            "value_loss_far", "Value loss of a critic that is far off (its values times 5)", 45,
            ppo(values=5 * g.new_values)[1]["value_loss"],
            ("error_clamped", "Each squared error is cut off at 10, and gives no gradient above.", far.clamp(max=10).mean()),
        ),
        _formula("entropy_loss", "Entropy term of the loss", 45, entropy_loss(g.entropy)),
        _formula("entropy_of_two_actions", "Entropy term of the loss, of a policy with two actions", 45, entropy_loss(two_actions)),
        _formula("total_loss", "Whole loss", 45, ppo()[0]),
    ]  # fmt: skip


def _silenced(logp, old_logp, advantages, clip_range):
    ratio = (logp - old_logp).exp()
    return (ratio.clamp(1 - clip_range, 1 + clip_range) * advantages < ratio * advantages).double().mean()


# ---- soft actor-critic: chapter 47 ----------------------------------------------------------------------------------


def _sac(g: SimpleNamespace) -> list[Formula]:
    target = ch47.soft_q_target(g.sac_rewards, g.sac_terminated, g.q1, g.q2, g.next_logp, g.alpha, g.gamma)
    nothing = torch.zeros_like(g.q1)
    log_alpha = torch.tensor(math.log(g.alpha), dtype=torch.float64)
    alpha = log_alpha.exp()
    both = functional.mse_loss(g.q1, target) + functional.mse_loss(g.q2, target)
    return [
        _formula("soft_q_target", "Target of SAC's critics", 47, target),
        _formula("soft_value", "Soft value of the next state", 47,
                 ch47.soft_q_target(nothing, nothing.bool(), g.q1, g.q2, g.next_logp, g.alpha, 1.0)),
        _formula("sac_actor_loss", "SAC's actor loss", 47, ch47.sac_actor_loss(g.q1, g.q2, g.next_logp, alpha)),
        _formula("sac_critic_loss", "SAC's critic loss", 47, _course_critic_loss(g),
                 ("half", "Half of the sum of both mean squared errors.", both / 2)),
        _formula(
            "temperature_loss", "SAC's temperature loss", 47, ch47.temperature_loss(log_alpha, g.next_logp, g.target_entropy),
            ("log_alpha", "log α stands in the place of α; the sign of the gradient is the same, its size is not.",
             -(log_alpha * (g.next_logp + g.target_entropy)).mean()),
        ),
    ]  # fmt: skip


class _Fixed:
    """Critics that answer with given numbers; `weights` is what an optimiser would move."""

    def __init__(self, answers: torch.Tensor) -> None:
        self.answers, self.weights = answers, torch.zeros((), dtype=torch.float64, requires_grad=True)

    def __call__(self, inputs: torch.Tensor, learn: bool = True) -> torch.Tensor:
        return self.answers + self.weights

    def step(self, gradient: torch.Tensor) -> None:
        """Stays where it is."""


def _course_critic_loss(g: SimpleNamespace) -> torch.Tensor:
    """What course_lib.control.sac.update reports, of an agent whose networks give the numbers of the input."""
    critics, actor, temperature = _Fixed(torch.stack([g.q1, g.q2])[..., None]), _Fixed(g.next_logp), _Fixed(g.next_logp)
    nothing = torch.zeros(len(g.q1), 1, dtype=torch.float64)
    agent: Any = SimpleNamespace(
        log_alpha=temperature.weights + math.log(g.alpha), target_entropy=g.target_entropy, critics=critics, targets=critics,
        critics_optimizer=critics, actor_optimizer=actor, temperature_optimizer=temperature,
        sample=lambda obs, generator, log_prob: (nothing, actor(obs)),
    )  # fmt: skip
    batch: Any = SimpleNamespace(
        obs=nothing, actions=nothing, next_obs=nothing, rewards=g.sac_rewards, terminated=g.sac_terminated
    )
    settings: Any = SimpleNamespace(gamma=g.gamma, tau=0.0)
    taught: Any = SimpleNamespace(
        soft_q_target=ch47.soft_q_target, sac_actor_loss=ch47.sac_actor_loss, temperature_loss=ch47.temperature_loss,
        polyak_update=ch47.polyak_update, squashed_gaussian_log_prob=None,
    )  # fmt: skip
    return sac.update(agent, batch, settings, taught, torch.Generator())["critic_loss"]


# ---- imitation and preferences: chapters 74 and 80 ------------------------------------------------------------------


def _imitation(g: SimpleNamespace) -> list[Formula]:
    loss = ch74.behavioural_cloning_loss(g.bc_logits, g.bc_actions)
    entropy = torch.distributions.Categorical(logits=g.bc_logits).entropy().mean()
    gap = {name: torch.tensor([size], dtype=torch.float64) for name, size in zip(("near", "far"), g.far_gaps, strict=True)}
    none = torch.zeros(1, dtype=torch.float64)
    return [
        _formula("behavioural_cloning_loss", "Behavioural cloning loss", 74, loss,
                 ("entropy_bonus", "0.001 times the policy's entropy is taken off.", loss - 1e-3 * entropy)),
        _formula("preference_probability", "Probability of a preference", 80, ch80.preference_probability(g.rm_chosen, g.rm_rejected)),
        _formula("preference_loss", "Preference loss", 80, ch80.bradley_terry_loss(g.rm_chosen, g.rm_rejected)),
        _formula("preference_loss_30", "Preference loss where the chosen segment's return is 30 lower", 80,
                 ch80.bradley_terry_loss(none, gap["near"])),
        _formula("preference_loss_200", "Preference loss where the chosen segment's return is 200 lower", 80,
                 ch80.bradley_terry_loss(none, gap["far"]),
                 ("gap_cut_off", "The difference of returns is cut off at 50, and gives no gradient beyond.",
                  ch80.bradley_terry_loss(none, gap["far"].clamp(max=50)))),
    ]  # fmt: skip


# ---- tokens: chapter 95 ---------------------------------------------------------------------------------------------


def _tokens(g: SimpleNamespace) -> list[Formula]:
    mask, whole = g.mask, torch.ones_like(g.mask)
    rewards = ch95.kl_penalized_rewards(g.score, g.tok_old, g.tok_ref, mask, g.kl_coef)
    advantages = ch95.masked_gae(rewards, g.tok_values, mask, g.tok_gamma, g.gae_lambda)
    ratio = (g.tok_logp - g.tok_old).exp()
    terms = -torch.minimum(ratio * g.tok_adv, ratio.clamp(1 - g.clip_range, 1 + g.clip_range) * g.tok_adv)
    rows = [(terms[i][mask[i]]) for i in range(len(mask))]
    squares = (g.tok_new_values - g.tok_returns) ** 2
    near = g.tok_values + (g.tok_new_values - g.tok_values).clamp(-g.tok_clip_range_vf, g.tok_clip_range_vf)
    larger = torch.maximum(squares, (near - g.tok_returns) ** 2)
    one = {
        name: torch.tensor([[getattr(g, name)]], dtype=torch.float64)
        for name in ("far_logp", "far_old", "far_adv", "k3_logp", "k3_ref")
    }
    far = ch95.ppo_token_loss(one["far_logp"], one["far_old"], one["far_adv"], whole[:1, :1], g.clip_range)
    k3 = torch.stack([ch43.approx_kl(r[None], p[None]) for r, p in zip(g.tok_ref[mask], g.tok_old[mask], strict=True)])
    k3_far = ch43.approx_kl(one["k3_ref"][0], one["k3_logp"][0])

    def whitened(x, correction, keep_mean=False, by_row=False):
        kept = [x[i][mask[i]] for i in range(len(x))] if by_row else [x[mask]] * len(x)
        parts = [
            (row - part.mean()) / part.std(correction=correction) + keep_mean * part.mean()
            for row, part in zip(x, kept, strict=True)
        ]
        return torch.where(mask, torch.stack(parts), 0)

    unbiased = "The variance is the unbiased one."
    return [
        _formula("kl_penalised_rewards", "Rewards with a penalty for leaving the reference", 95, rewards),
        _formula(
            "token_gae", "Advantages of tokens", 95, advantages,
            ("padding_leaks", "The critic's values at the padding count, unless the caller has set them to 0.",
             torch.where(mask, ch95.masked_gae(rewards, g.tok_values, whole, g.tok_gamma, g.gae_lambda), 0)),
        ),
        _formula("whitened", "Whitening of given advantages", 95, ch95.masked_whiten(g.tok_adv, mask),
                 ("unbiased", unbiased, whitened(g.tok_adv, 1)),
                 ("by_row", "Each row has its own mean and (biased) variance.", whitened(g.tok_adv, 0, by_row=True))),
        _formula("whitened_token_gae", "Advantages of tokens, whitened", 95, ch95.masked_whiten(advantages, mask),
                 ("unbiased", unbiased, whitened(advantages, 1)),
                 ("unbiased_mean_kept", "The variance is the unbiased one, and the mean is added again.",
                  whitened(advantages, 1, keep_mean=True))),
        _formula(
            "token_policy_loss", "Clipped surrogate loss of tokens", 95,
            ch95.ppo_token_loss(g.tok_logp, g.tok_old, g.tok_adv, mask, g.clip_range),
            ("row_means", "The mean of each row's mean: a token of a short answer counts for more.",
             torch.stack([row.mean() for row in rows]).mean()),
            ("row_sums", "The mean of each row's sum.", torch.stack([row.sum() for row in rows]).mean()),
        ),
        _formula("token_policy_loss_far", "Clipped surrogate loss of one token of ratio 5 whose advantage is -1", 95, far,
                 ("dual_clip", "A second clip bounds it at 3 |A|.", 3 * one["far_adv"].abs().mean())),
        _formula("token_approx_kl", "Approximate KL divergence of tokens", 95, ch43.approx_kl(g.tok_logp[mask], g.tok_old[mask]),
                 ("k1", "k1, the mean of old minus new log-probabilities, which may be negative.", (g.tok_old - g.tok_logp)[mask].mean())),
        _formula(
            "token_clip_fraction", "Clip fraction of tokens", 95, ch43.clip_fraction(g.tok_logp[mask], g.tok_old[mask], g.clip_range),
            ("silenced", "Only tokens count whose gradient the clip takes away.",
             _silenced(g.tok_logp[mask], g.tok_old[mask], g.tok_adv[mask], g.clip_range)),
        ),
        _formula("token_value_loss", "Value loss of tokens", 95, ch95.masked_mean(squares, mask),
                 ("half", "Half of the mean squared error.", ch95.masked_mean(squares, mask) / 2)),
        _formula("token_value_loss_clipped", "Value loss of tokens, clipped", None, ch95.masked_mean(larger, mask),
                 ("half", "Half of it.", ch95.masked_mean(larger, mask) / 2)),
        _formula("token_k3", "k3 of each token against the reference", 95, k3),
        _formula("token_k3_far", "k3 of a token that the reference finds e^4.5 times as likely", 95, k3_far,
                 ("cut_off", "It is cut off at 10.", k3_far.clamp(max=10))),
    ]  # fmt: skip


# ---- pairs: chapters 96 and 97 --------------------------------------------------------------------------------------


def to_the_left(tokens: list[list[float]], mask: list[list[int]]) -> list[list[float]]:
    """Rows whose padding is moved from the right to the left."""
    return [row[sum(kept) :] + row[: sum(kept)] for row, kept in zip(tokens, mask, strict=True)]


def _scores(g: SimpleNamespace) -> list[Formula]:
    loss = ch96.reward_model_loss(g.rm_chosen, g.rm_rejected)
    last = {
        name: ch96.last_token_scores(getattr(g, f"rm_{name}_tokens"), getattr(g, f"rm_{name}_mask"))
        for name in ("chosen", "rejected")
    }
    left = {
        name: torch.tensor(to_the_left(GIVEN[f"rm_{name}_tokens"], GIVEN[f"rm_{name}_mask"]), dtype=torch.float64)
        for name in ("chosen", "rejected")
    }
    at_count = {name: left[name].gather(1, getattr(g, f"rm_{name}_mask").sum(1)[:, None] - 1)[:, 0] for name in left}
    centred = loss + g.center_coef * ((g.rm_chosen + g.rm_rejected) ** 2).mean()
    return [
        _formula("reward_model_loss", "Reward model's loss", 96, loss),
        _formula("reward_model_loss_margin", "Reward model's loss with a margin", 96,
                 ch96.reward_model_loss(g.rm_chosen, g.rm_rejected, g.margin)),
        _formula("reward_model_loss_centred", "Reward model's loss that draws scores to 0", None, centred),
        _formula("reward_model_loss_padded", "Reward model's loss, scores at the last of several tokens", 96,
                 ch96.reward_model_loss(last["chosen"], last["rejected"])),
        _formula("reward_model_loss_left", "Reward model's loss, the padding on the left", 96,
                 ch96.reward_model_loss(last["chosen"], last["rejected"]),
                 ("at_count", "The score is read at the number of kept tokens less one: the last of them only if padding is on the right.",
                  ch96.reward_model_loss(at_count["chosen"], at_count["rejected"]))),
    ]  # fmt: skip


def _pairs(g: SimpleNamespace) -> list[Formula]:
    pairs = (g.chosen, g.rejected, g.ref_chosen, g.ref_rejected)
    lengths = (g.chosen_lengths, g.rejected_lengths, g.chosen_lengths, g.rejected_lengths)
    averages = [x / n for x, n in zip(pairs, lengths, strict=True)]
    s = g.label_smoothing
    losses, chosen_rewards, rejected_rewards = ch97.dpo_loss(*pairs, g.beta)
    smoothed = ch97.dpo_loss(*pairs, g.beta, s)[0]
    margins = chosen_rewards - rejected_rewards
    robust = ((1 - s) * -functional.logsigmoid(margins) + s * functional.logsigmoid(-margins)) / (1 - 2 * s)
    ipo, ipo_averages = ch97.ipo_loss(*pairs, g.beta), ch97.ipo_loss(averages[0], averages[1], averages[2], averages[3], g.beta)
    simpo = -functional.logsigmoid(g.beta * (g.chosen - g.rejected) - g.simpo_gamma)
    by_token = "Log-probabilities are averaged over each completion's tokens, not summed."
    return [
        _formula("dpo_loss", "DPO's loss of each pair", 97, losses),
        _formula("dpo_loss_mean", "DPO's loss, the mean", 97, losses.mean()),
        _formula("dpo_loss_smoothed", "DPO's loss of each pair with label smoothing", 97, smoothed),
        _formula(
            "dpo_loss_smoothed_mean", "DPO's loss with label smoothing, the mean", 97, smoothed.mean(),
            ("ignored", "The smoothing is ignored, without a word.", losses.mean()),
            ("robust", "Another formula, robust DPO: ((1 - s) loss - s loss of the pair turned round) / (1 - 2 s).", robust.mean()),
        ),
        _formula("implicit_rewards", "DPO's implicit rewards of the chosen", 97, chosen_rewards),
        _formula("implicit_margin", "DPO's implicit margin, the mean", 97, margins.mean()),
        _formula("ipo_loss", "IPO's loss of each pair", 97, ipo, ("token_averages", by_token, ipo_averages)),
        _formula("ipo_loss_mean", "IPO's loss, the mean", 97, ipo.mean(), ("token_averages", by_token, ipo_averages.mean())),
        _formula("simpo_loss", "SimPO's loss of given log-probabilities", None, simpo),
    ]  # fmt: skip


def _groups(g: SimpleNamespace) -> list[Formula]:
    rewards = g.group_rewards
    centred = rewards - rewards.mean(1, keepdim=True)
    size = rewards.shape[1]
    return [
        _formula("group_advantages", "GRPO's advantages in groups of four", None, centred / (rewards.std(1, keepdim=True) + 1e-8)),
        _formula("group_advantages_batch", "GRPO's advantages, the deviation of the whole batch", None, centred / rewards.std()),
        _formula("group_advantages_centred", "GRPO's advantages, centred only", None, centred),
        _formula("rloo_advantages", "RLOO's advantages", None, centred * size / (size - 1)),
        _formula("group_deviation", "Standard deviation of a group", None, rewards.std(1),
                 ("biased", "The biased one.", rewards.std(1, correction=0))),
        _formula("group_of_one", "GRPO's advantage of a group of one", None, 0.0,
                 ("reward_itself", "The mean is taken for 0 and the deviation for 1: the reward itself goes through.", g.lone_reward)),
    ]  # fmt: skip
