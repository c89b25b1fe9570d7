"""The agent and the loop of soft actor-critic: what is stored, what is scaled, what is learned from, and that a run goes on."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from course_lib.control import sac
from solutions import ch47

TAUGHT = sac.Taught.of(vars(ch47))
SMALL = sac.SACSettings(total_steps=60, learning_starts=20, batch_size=8, hidden=8)


class Corridor(gym.Env):
    """Step k of episode n leads to the observation n + k / 10; it terminates at step 3 if asked to, and is cut off at step 5."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Box(np.array([0, -4], np.float32), np.array([1, 4], np.float32))

    def __init__(self, terminates):
        self.terminates, self.episode, self.sent = terminates, 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.count = self.episode + 1, 0
        return self.obs(), {}

    def obs(self):
        return np.array([self.episode + 0.1 * self.count], np.float32)

    def step(self, action):
        self.count += 1
        self.sent.append(action)
        return self.obs(), float(self.count), self.terminates and self.count == 3, self.count == 5, {}


def test_functions_come_from_the_namespace_first(monkeypatch):
    monkeypatch.setattr(sac, "earlier", lambda name, chapter: (name, chapter))
    taught = sac.Taught.of({"soft_q_target": len})
    assert taught.soft_q_target is len and taught.polyak_update == ("polyak_update", 47)


@pytest.mark.parametrize(("terminates", "length"), [(True, 3), (False, 5)])
def test_the_buffer_keeps_true_successors_and_terminations_only(terminates, length):
    training = sac.Training(Corridor(terminates), SMALL, 0, TAUGHT)
    training.advance(20)
    steps = training.buffer[torch.arange(20)]
    torch.testing.assert_close(steps.next_obs, steps.obs + 0.1)  # never that of the next episode
    taken = (10 * steps.next_obs[:, 0].frac()).round()
    assert torch.equal(steps.terminated, (taken == 3) & terminates)
    assert taken.max() == length, "episodes end, and the one at the limit has not terminated"


def test_the_environment_gets_scaled_actions_and_the_buffer_those_of_the_policy():
    world = Corridor(True)
    training = sac.Training(world, SMALL, 0, TAUGHT)
    training.advance(60)
    kept, sent = training.buffer[torch.arange(60)].actions, torch.from_numpy(np.stack(world.sent))
    assert kept.abs().max() <= 1 and kept.min() < -0.5
    torch.testing.assert_close(sent, torch.stack([0.5 * (kept[:, 0] + 1), 4 * kept[:, 1]], 1))


def test_nothing_is_learned_before_learning_starts_and_everything_moves_after():
    training = sac.Training(Corridor(True), SMALL, 0, TAUGHT)
    before = [tensor.detach().clone() for tensor in training.agent.tensors()]
    training.advance(20)
    assert all(torch.equal(old, new) for old, new in zip(before, training.agent.tensors(), strict=True))
    training.advance(1)
    assert not any(torch.equal(old, new) for old, new in zip(before, training.agent.tensors(), strict=True))


def test_the_actor_moves_no_critic_and_the_critic_no_actor():
    agent = sac.Agent(3, [-1.0], [1.0], SMALL)
    obs = torch.randn(8, 3, generator=torch.Generator().manual_seed(0))
    actions, log_probs = agent.sample(obs, torch.Generator().manual_seed(1), TAUGHT.squashed_gaussian_log_prob)
    q1, q2 = sac.values(agent.critics, obs, actions, learn=False)
    TAUGHT.sac_actor_loss(q1, q2, log_probs, 0.1).backward()
    assert agent.critics.weights.grad is None and agent.actor.weights.grad.abs().sum() > 0


def test_actions_lie_within_bounds_and_the_best_is_the_middle_of_the_distribution():
    agent = sac.Agent(3, [0.0, -4.0], [1.0, 4.0], SMALL, seed=1)
    obs = np.random.default_rng(0).normal(size=(50, 3))
    drawn = agent.act(obs, torch.Generator().manual_seed(0))
    assert drawn.shape == (50, 2) and drawn.abs().max() < 1
    mean, _ = agent.distribution(torch.as_tensor(obs, dtype=torch.float32))
    torch.testing.assert_close(agent.best_action(obs)[:, 1], 4 * mean[:, 1].tanh().detach())


def test_a_loaded_agent_and_buffer_go_on_with_the_same_numbers():
    batch = sac.Training(Corridor(True), SMALL, 0, TAUGHT)
    batch.advance(40)
    copy = sac.Training(Corridor(True), SMALL, 5, TAUGHT)
    copy.load_state_dict(batch.state_dict())
    for training in (batch, copy):
        for _ in range(3):
            training.learn()
    for one, other in zip(batch.agent.tensors(), copy.agent.tensors(), strict=True):
        assert torch.equal(one, other)
    assert copy.env_steps == 40 and copy.finished == batch.finished


def test_rows_reach_the_end_and_say_what_was_learned():
    rows = list(sac.Training(Corridor(True), SMALL, 0, TAUGHT).rows(every=25))
    assert [row["env_steps"] for row in rows] == [25, 50, 60]
    assert {"mean_return", "critic_loss", "q", "entropy", "alpha", "seconds"} == rows[-1].keys() - {"env_steps"}
    assert rows[0]["mean_return"] == 6  # 1 + 2 + 3
