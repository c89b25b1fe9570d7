"""Rewards learned from comparisons of clips, and what PPO makes of them: CartPole, Pendulum, and a car whose passenger is misread."""

from __future__ import annotations

import math
from dataclasses import fields

import torch

from course_lib.control import clips, envs, tasks
from course_lib.control.policies import make_policy, policy_for
from course_lib.control.ppo import PPOSettings
from experiments.campaign import Result
from solutions.ch45 import collect_rollout, evaluate_actions, fast_ppo_update, train_ppo
from solutions.ch80 import bradley_terry_loss, preference_accuracy, segment_returns, simulate_preferences

COMPARISONS = (0, 30, 100, 300, 1000, 3000)
NOISE = {
    "sure": 0.02,
    "unsure": 0.5,
    "guessing": 2.0,
}  # the person's temperature, in standard deviations of the clips' true returns
KL_COEFS = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0)
ENSEMBLE = {"members": 3, "times": 10, "candidates": 1000}  # asked ten times, for a tenth of the comparisons among so many pairs

VARIANTS: dict[str, dict] = {
    **{f"cruise_{kl_coef:g}": {"task": "cruise", "comparisons": 100, "noise": 0.5, "kl_coef": kl_coef} for kl_coef in KL_COEFS},
    "cruise_rounds": {"task": "cruise", "comparisons": 100, "noise": 0.5, "rounds": 5},
    **{f"{task}_true": {"task": task, "comparisons": None} for task in ("cruise", "pendulum", "cartpole")},
    **{
        f"{task}_{count}_{noise}": {"task": task, "comparisons": count, "noise": NOISE[noise]}
        for task, noises in (("pendulum", ("sure", "unsure", "guessing")), ("cartpole", ("sure", "unsure")))
        for noise in noises
        for count in COMPARISONS
        if count or noise == "sure"
    },
    "pendulum_rounds": {"task": "pendulum", "comparisons": 300, "noise": NOISE["unsure"], "rounds": 5},
    "cartpole_rounds": {"task": "cartpole", "comparisons": 300, "noise": NOISE["sure"], "rounds": 5},
    **{
        f"pendulum_queries_{rule}{person}": {"task": "pendulum", "queries": rule, "comparisons": 300, "noise": noise} | ENSEMBLE
        for rule in ("random", "disagreement")
        for person, noise in (("", NOISE["unsure"]), ("_sure", NOISE["sure"]))
    },
    "pendulum_models": {"task": "pendulum", "models": [[count, noise] for noise in NOISE for count in COMPARISONS[1:]]},
    "cruise_models": {"task": "cruise", "models": [[100, "unsure"]]},
}
# five seeds do not draw a curve against the number of comparisons
TWICE = [name for name, choice in VARIANTS.items() if choice["task"] != "cruise" and "queries" not in choice]
SEEDS = dict.fromkeys(VARIANTS, 5) | dict.fromkeys(TWICE, 10)

SETTINGS = {
    "cartpole": PPOSettings(
        total_steps=49_152,
        num_steps=128,
        minibatch_size=256,
        num_epochs=6,
        learning_rate=2e-3,
        gamma=0.99,
        gae_lambda=0.95,
    ),
    "pendulum": PPOSettings(
        total_steps=96_000,
        num_steps=200,
        minibatch_size=320,
        num_epochs=8,
        learning_rate=2e-3,
        gamma=0.95,
        gae_lambda=0.95,
        ent_coef=0.0,
    ),
    "cruise": PPOSettings(
        total_steps=64_000,
        num_steps=50,
        minibatch_size=320,
        num_epochs=6,
        learning_rate=1e-3,
        gamma=0.9,
        gae_lambda=0.95,
        ent_coef=0.0,
    ),
}
TRUE_SCALE = {"cartpole": 1.0, "pendulum": 0.1, "cruise": 1.0}  # what the true rewards are multiplied by when PPO sees them
CLIP_LENGTH = {"cartpole": 50, "pendulum": 25, "cruise": 10}
HORIZON = {"cartpole": 500, "pendulum": 200, "cruise": 50}  # steps of a whole episode
POOL = 1000  # clips that all comparisons are drawn from
HELD_OUT = 500


def make_envs(task, num_envs=32, time_limit=None):
    """N copies of a task; a time limit shorter than its own lets clips begin in more places."""
    if task == "cartpole":
        return envs.make("CartPole-v1", num_envs)
    kind = tasks.PendulumVectorEnv if task == "pendulum" else tasks.CruiseVectorEnv
    return kind(num_envs, time_limit=time_limit or HORIZON[task])


def first_policy(task, seed):
    """Who drives in the first clips, and where PPO begins: an untrained policy, or a driver who asks for a speed of 0.4."""
    if task != "cruise":
        return policy_for(make_envs(task, 1), seed=seed)
    driver = make_policy(1, 1, log_std=math.log(0.15), seed=seed)
    driver.tensors()["actor.out.bias"].fill_(-0.8)
    return driver


def collect_clips(task, policy, count, seed):
    """`count` clips of a policy, in random order."""
    generator, length = torch.Generator().manual_seed(seed), CLIP_LENGTH[task]
    world = make_envs(task, 32 if task == "cartpole" else 250, time_limit=length if task == "pendulum" else None)
    obs = world.reset(seed=seed)[0]
    found: list[clips.Segments] = []
    while sum(len(part) for part in found) < count:
        rollout = collect_rollout(world, policy, 250 if task == "cartpole" else 2 * length, obs, generator)
        found.append(clips.cut(rollout, length))
        obs = rollout.last_obs
    together = joined(found)
    return together[torch.randperm(len(together), generator=generator)[:count]]


def joined(parts):
    """Several Segments as one."""
    columns = [field.name for field in fields(clips.Segments)]
    return clips.Segments(*(torch.cat([getattr(part, column) for part in parts]) for column in columns))


def ask(pool, comparisons, noise, seed):
    """Show a simulated person pairs of clips. Returns: (chosen, rejected, share of answers against the better clip)."""
    generator = torch.Generator().manual_seed(seed)
    first, second = clips.draw_pairs(len(pool), comparisons, generator)
    return answered(pool, first, second, noise, generator)


def answered(pool, first, second, noise, generator):
    """As `ask`, about these pairs."""
    returns = segment_returns(pool.rewards, pool.mask).double()
    temperature = max(noise * returns.std().item(), 1e-3)  # clips may all be alike
    answers = simulate_preferences(returns[first], returns[second], temperature, generator)
    differ = returns[first] != returns[second]
    mistakes = differ & (answers != (returns[first] > returns[second]))
    chosen, rejected = torch.where(answers, first, second), torch.where(answers, second, first)
    return pool[chosen], pool[rejected], mistakes.sum().item() / max(differ.sum().item(), 1)


class Ensemble(torch.nn.Module):
    """Reward models of different seeds, fitted to the same answers; what they give together is the mean."""

    def __init__(self, members):
        super().__init__()
        self.members = torch.nn.ModuleList(members)

    def forward(self, obs, actions):
        """Rewards (...,) of obs (..., O) and actions (..., A)."""
        return torch.stack([member(obs, actions) for member in self.members]).mean(0)

    def returns(self, segments):
        """Of each clip from each member, (members, B)."""
        return torch.stack([segment_returns(member(segments.obs, segments.actions), segments.mask) for member in self.members])


def asked_in_turn(choice, policy, seed, report):
    """Ask for comparisons of one policy's clips, a few at a time: about random pairs, or those that the members disagree on most.

    Returns: the clips, the ensemble after the last answer, and a row for each time: answers so far, and how well they teach.
    """
    task, count = choice["task"], choice["comparisons"] // choice["times"]
    generator = torch.Generator().manual_seed(seed)
    pool, held_out = collect_clips(task, policy, POOL, seed), collect_clips(task, policy, HELD_OUT, 1000 + seed)
    asked: list = []
    rows: list[dict] = []
    ensemble = None
    for time in range(choice["times"]):
        first, second = clips.draw_pairs(len(pool), choice["candidates"], generator)
        picked = torch.arange(count)
        if ensemble and choice["queries"] == "disagreement":
            returns = ensemble.returns(pool)  # (members, clips)
            picked = torch.sigmoid(returns[:, first] - returns[:, second]).std(0).topk(count).indices
        asked.append(answered(pool, first[picked], second[picked], choice["noise"], generator))
        chosen, rejected = (joined(parts) for parts in list(zip(*asked, strict=True))[:2])
        members = []
        for own_seed in (seed + 1000 * member for member in range(choice["members"])):
            members.append(clips.RewardModel(pool.obs.shape[-1], pool.actions.shape[-1], seed=own_seed).scale_to(pool))
            clips.fit(members[-1], chosen, rejected, preference_loss, seed=own_seed)
        ensemble = Ensemble(members).requires_grad_(False)
        mistakes = sum(entry[2] for entry in asked) / len(asked)
        rows.append({"comparisons": len(chosen), "mistakes": mistakes} | quality(ensemble, held_out))
        report(time + 1, choice["times"])
    return pool, ensemble, rows


def preference_loss(model, chosen, rejected):
    """The Bradley-Terry loss of a minibatch of pairs."""
    better, worse = (segment_returns(model(clip.obs, clip.actions), clip.mask) for clip in (chosen, rejected))
    return bradley_terry_loss(better, worse)


def quality(model, held_out):
    """How well a reward model foresees fresh clips of the first policy, without anybody's mistakes."""
    rewards = model(held_out.obs, held_out.actions)
    returns, truth = segment_returns(rewards, held_out.mask), segment_returns(held_out.rewards, held_out.mask)
    (first, second), (true_first, true_second) = returns.view(2, -1), truth.view(2, -1)
    differ, better = true_first != true_second, true_first > true_second
    chosen, rejected = torch.where(better, first, second), torch.where(better, second, first)
    return {
        "accuracy": preference_accuracy(chosen[differ], rejected[differ]).item(),
        "correlation_clips": correlation(returns, truth),
        "correlation_steps": correlation(rewards[held_out.mask], held_out.rewards[held_out.mask]),
    }


def correlation(x, y):
    """Pearson's correlation of two tensors of numbers, NaN where one is constant."""
    x, y = (numbers.double() - numbers.double().mean() for numbers in (x, y))
    norm = (x.norm() * y.norm()).item()
    return (x @ y).item() / norm if norm > 0 else math.nan


def fitted(pool, comparisons, noise, task, seed):
    """The reward model that `run` fits in its first round. Returns: (model, share of the answers that are mistakes, losses)."""
    chosen, rejected, mistakes = ask(pool, comparisons, noise, seed)
    model = clips.RewardModel(pool.obs.shape[-1], 0 if task == "cruise" else pool.actions.shape[-1], seed=seed).scale_to(pool)
    return model, mistakes, clips.fit(model, chosen, rejected, preference_loss, seed=seed)


def reward_tables(choice, policy, seed, report):
    """What the models of `run` give, as PPO gets it, wherever one could be: a row for each state of a grid and each action, with a
    column for each model and one for the true reward. No policy is trained.
    """
    task = choice["task"]
    if task == "cruise":  # a step is judged by the speed that it leads to
        speeds = torch.linspace(0, 3, 61)
        columns = {"speed": speeds, "true": tasks.CruiseVectorEnv.passenger(speeds)}
        obs = actions = speeds[:, None]
    else:
        grid = torch.cartesian_prod(torch.arange(-8, 8) * math.pi / 8, torch.arange(-8.0, 9.0, 2.0), torch.arange(-2.0, 3.0))
        angle, velocity, torque = grid.T
        truth = -(angle**2 + 0.1 * velocity**2 + 0.001 * torque**2)
        columns = {"angle": angle, "velocity": velocity, "torque": torque, "true": truth}
        obs, actions = torch.stack([angle.cos(), angle.sin(), velocity], dim=1), torque[:, None]
    pool = collect_clips(task, policy, POOL, seed)
    for done, (count, person) in enumerate(choice["models"], 1):
        model, *_ = fitted(pool, count, NOISE[person], task, seed)
        columns[f"{count}_{person}"] = frozen_reward(task, model, pool)(obs, actions, obs)
        report(done, len(choice["models"]))
    names = list(columns)
    return [dict(zip(names, row, strict=True)) for row in torch.stack(list(columns.values()), dim=1).tolist()]


def frozen_reward(task, model, pool):
    """The learned reward as PPO gets it, `reward(obs, actions, next_obs) -> (T, N)`, on a scale fixed by the clips.

    Its level is nobody's choice where all clips are of one length: the mean becomes 0. Where episodes end, the level decides whether it
    pays to go on; there the comparisons have told it, and only the unit changes.
    """
    model.requires_grad_(False)
    rewards = model(pool.obs, pool.actions)[pool.mask]
    level, scale = (0.0, rewards.square().mean().sqrt()) if task == "cartpole" else (rewards.mean(), rewards.std())

    def reward(obs, actions, next_obs):
        seen = next_obs if task == "cruise" else obs  # a step of the car is judged by the speed that it leads to
        return (model(seen, actions.float().view(*obs.shape[:-1], -1)) - level) / (scale + 1e-8)

    return reward


def log_ratios(policy, reference, obs, actions):
    """log π(a|s) - log π_ref(a|s) of every step, (T, N); its mean over the policy's own steps is the divergence from the reference."""
    ours, theirs = (evaluate_actions(one, obs.flatten(0, 1), actions.flatten(0, 1))[0].detach() for one in (policy, reference))
    return (ours - theirs).view(obs.shape[:2])


def run(variant, seed, checkpoint_dir, report):
    """Collect clips, ask for comparisons, fit a reward, train PPO on it, in one round or several; then look at the true return."""
    choice = VARIANTS[variant]
    task, rounds, kl_coef = choice["task"], choice.get("rounds", 1), choice.get("kl_coef", 0.0)
    settings = SETTINGS[task].but(total_steps=SETTINGS[task].total_steps // rounds)
    policy, reference = first_policy(task, 100 + seed), first_policy(task, 100 + seed)
    rows: list[dict] = []
    summary: dict = {}

    def train(round_number, learned):
        before = rows[-1]["env_steps"] if rows else 0
        latest: dict[str, float] = {}

        def reward(obs, actions, next_obs):
            paid = learned(obs, actions, next_obs)
            log_ratio = log_ratios(policy, reference, obs, actions)
            latest.update(learned=paid.mean().item(), kl=log_ratio.mean().item())
            return paid - kl_coef * log_ratio

        def log(row):
            rows.append({"env_steps": before + row["env_steps"], "mean_return": row["mean_return"]} | latest)
            report(before + row["env_steps"], settings.total_steps * rounds)

        scale = 1.0 if learned else TRUE_SCALE[task]
        world = make_envs(task)
        train_ppo(
            world, settings.but(reward_scale=scale), seed + 10 * round_number, policy, learned and reward, log, fast_ppo_update
        )

    def judge(learned):
        generator = torch.Generator().manual_seed(2000 + seed)
        world = make_envs(task, 64)
        rollout = collect_rollout(world, policy, HORIZON[task], world.reset(seed=2000 + seed)[0], generator)
        ended = (rollout.terminated | rollout.truncated).int()
        kept = ended.cumsum(0) - ended == 0  # each environment's first episode
        summary["true_return"] = (rollout.rewards * kept).sum(0).mean().item()
        if learned:
            given = learned(rollout.obs, rollout.actions, rollout.next_obs)
            summary["learned_return"] = (given * kept).sum(0).mean().item()
            summary["correlation_on_policy"] = correlation(given[kept], rollout.rewards[kept])
        if task == "cruise":
            summary["kl"] = log_ratios(policy, reference, rollout.obs, rollout.actions).mean().item()
            summary["speed"] = rollout.next_obs.mean().item()

    if "models" in choice:
        return Result(reward_tables(choice, policy, seed, report))

    if choice["comparisons"] is None:
        train(0, None)
        judge(None)
        return Result(rows, summary)

    if "queries" in choice:
        pool, ensemble, answers = asked_in_turn(choice, policy, seed, report)
        learned = frozen_reward(task, ensemble, pool)
        train(0, learned)
        judge(learned)
        return Result(answers, answers[-1] | summary)

    asked: list = []
    for round_number in range(rounds):
        pool = collect_clips(task, policy, POOL // rounds, seed + 10 * round_number)
        if choice["comparisons"]:
            asked.append(ask(pool, choice["comparisons"] // rounds, choice["noise"], seed + 10 * round_number))
        actions = 0 if task == "cruise" else pool.actions.shape[-1]
        model = clips.RewardModel(pool.obs.shape[-1], actions, seed=seed).scale_to(pool)
        if asked:
            chosen, rejected = (joined(parts) for parts in list(zip(*asked, strict=True))[:2])
            losses = clips.fit(model, chosen, rejected, preference_loss, seed=seed)
            summary |= {"mistakes": sum(entry[2] for entry in asked) / rounds, "loss": losses[-20:].mean().item()}
        learned = frozen_reward(task, model, pool)
        train(round_number, learned)
    summary |= quality(model, collect_clips(task, reference, HELD_OUT, 1000 + seed))
    judge(learned)
    return Result(rows, summary)
