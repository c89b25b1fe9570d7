# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "stable-baselines3==2.9.2"]
#
# [tool.atlas]
# libraries = ["stable-baselines3"]
# ///
"""`collect_rollouts` runs on an environment that plays the rollout, with a critic that returns the observation; `PPO.train` and `SAC.train`
run with a buffer and networks that hand out the input, and what they log is read."""

import gymnasium
import numpy as np
import torch
from sheet import given, row
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env.base_vec_env import VecEnv
from stable_baselines3.sac import sac

STEPS, ENVS = 8, 2
box = gymnasium.spaces.Box(-100, 100, (1,), np.float32)


class Played(VecEnv):
    """Its observation is the value of the state."""

    def __init__(self):
        super().__init__(ENVS, box, gymnasium.spaces.Box(-1, 1, (1,), np.float32))
        self.t = 0

    def observation(self):
        values = [(given.values[n] + given.last_values[n : n + 1])[self.t] for n in range(ENVS)]
        return np.array(values, np.float32)[:, None]

    def reset(self):
        return self.observation()

    def step_async(self, actions):
        pass

    def step_wait(self):
        t, self.t = self.t, self.t + 1
        rewards = np.array([given.rewards[n][t] for n in range(ENVS)], np.float32)
        dones, infos = np.zeros(ENVS, bool), [{} for _ in range(ENVS)]
        for n in range(ENVS):
            terminated, truncated = given.terminated[n][t], given.truncated[n][t]
            if terminated or truncated:
                dones[n] = True
                infos[n] = {
                    "terminal_observation": np.array([given.final_values[n][t]], np.float32),
                    "TimeLimit.truncated": bool(truncated and not terminated),
                }
        return self.observation(), rewards, dones, infos

    def close(self):
        pass

    def get_attr(self, name, indices=None):
        return [None] * ENVS

    def set_attr(self, name, value, indices=None):
        pass

    def env_method(self, name, *args, indices=None, **kwargs):
        return [None] * ENVS

    def env_is_wrapped(self, wrapper, indices=None):
        return [False] * ENVS


class Silent(BaseCallback):
    def _on_step(self):
        return True


def tensor(name):
    return torch.tensor(getattr(given, name))


def rollout():
    env = Played()
    model = PPO("MlpPolicy", env, n_steps=STEPS, gamma=given.gamma, gae_lambda=given.gae_lambda, batch_size=STEPS, device="cpu")
    model.policy.forward = lambda obs: (torch.zeros(ENVS, 1), obs, torch.zeros(ENVS))
    model.policy.predict_values = lambda obs: obs
    model.set_logger(Logger(None, []))
    model._last_obs, model._last_episode_starts = env.reset(), np.ones(ENVS, bool)
    model.ep_info_buffer, model.ep_success_buffer = [], []
    callback = Silent()
    callback.init_callback(model)
    model.collect_rollouts(env, callback, model.rollout_buffer, STEPS)
    return model.rollout_buffer


class Batch:
    values = returns = np.zeros(2)

    def get(self, size):
        yield RolloutBufferSamples(
            torch.zeros(6, 1), torch.zeros(6, 1), tensor("old_values"), tensor("old_logp"), tensor("adv"), tensor("returns")
        )


def ppo(**settings):
    """What PPO.train logs."""
    model = PPO(
        "MlpPolicy", Played(), n_steps=STEPS, batch_size=STEPS, n_epochs=1, clip_range=given.clip_range, device="cpu", **settings
    )
    model.set_logger(Logger(None, []))
    model.rollout_buffer = Batch()
    moved = next(model.policy.parameters())
    model.policy.evaluate_actions = lambda obs, actions: (
        tensor("new_values") + 0 * moved.sum(), tensor("logp") + 0 * moved.sum(), tensor("entropy")
    )  # fmt: skip
    model.train()
    return {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}


def soft_actor_critic(**settings):
    """What SAC.train logs, and the targets it fits its critics to."""
    model = SAC(
        "MlpPolicy", Played(), gamma=given.gamma, target_entropy=given.target_entropy, buffer_size=8, device="cpu", **settings
    )
    model.set_logger(Logger(None, []))
    column = {name: tensor(name)[:, None] for name in ("q1", "q2", "sac_rewards", "sac_terminated", "next_logp")}
    states = torch.zeros(4, 1)
    batch = ReplayBufferSamples(states, states, states, column["sac_terminated"].float(), column["sac_rewards"])
    model.replay_buffer = type("Buffer", (), {"sample": lambda self, size, env=None: batch})()
    moved, judged = next(model.actor.parameters()), next(model.critic.parameters())
    model.actor.action_log_prob = lambda obs: (states + 0 * moved.sum(), tensor("next_logp") + 0 * moved.sum())
    model.critic.forward = lambda obs, actions: [column[name] + 0 * judged.sum() + 0 * actions for name in ("q1", "q2")]
    model.critic_target.forward = lambda obs, actions: (column["q1"], column["q2"])
    targets = []

    class Recorded:
        @staticmethod
        def mse_loss(guess, target):
            targets.append(target)
            return torch.nn.functional.mse_loss(guess, target)

    sac.F = Recorded
    model.train(1, 4)
    return {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}, targets[0]


buffer = rollout()
source = "stable_baselines3/common/on_policy_algorithm.py"
call = "PPO.collect_rollouts"
row("gae", buffer.advantages.T, call, source)
row("stored_reward", buffer.rewards[5, 0], call, source)

source, call = "stable_baselines3/ppo/ppo.py", "PPO.train"
plain = ppo(normalize_advantage=False, vf_coef=given.vf_coef, ent_coef=given.ent_coef)
row("policy_loss", plain["policy_gradient_loss"], call, source, "normalize_advantage=False")
row("approx_kl", plain["approx_kl"], call, source)
row("clip_fraction", plain["clip_fraction"], call, source)
row("value_loss", plain["value_loss"], call, source)
row("entropy_loss", plain["entropy_loss"], call, source, note="Minus the mean entropy is logged.")
row("total_loss", plain["loss"], call, source, "normalize_advantage=False, ent_coef=0.01")
row("policy_loss_normalised", ppo()["policy_gradient_loss"], call, source, "normalize_advantage=True, the default")
row("value_loss_clipped", ppo(clip_range_vf=given.clip_range)["value_loss"], call, source, "clip_range_vf=0.2")
row(
    "explained_variance", explained_variance(np.array(given.new_values), np.array(given.returns)), "common.utils.explained_variance",
    "stable_baselines3/common/utils.py",
)  # fmt: skip

source, call = "stable_baselines3/sac/sac.py", "SAC.train"
logged, target = soft_actor_critic(ent_coef=given.alpha)
row("soft_q_target", target.flatten(), call, source)
row("sac_actor_loss", logged["actor_loss"], call, source)
row("sac_critic_loss", logged["critic_loss"], call, source)
logged, _ = soft_actor_critic(ent_coef=f"auto_{given.alpha}")
row("temperature_loss", logged["ent_coef_loss"], call, source, "ent_coef='auto', the default")
