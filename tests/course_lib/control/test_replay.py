"""The replay buffer: it wraps, gives back what was put in, and goes on from its state."""

import pytest
import torch

from course_lib.control.replay import ReplayBuffer


def add(buffer, first, last):
    """Steps number first to last - 1: step i leads from i to i + 1 and has the action -i, the reward 10 i; every third terminates."""
    steps = torch.arange(first, last, dtype=torch.float32)
    pair = torch.stack([steps, steps], 1)
    buffer.add(pair, -steps[:, None], 10 * steps, pair + 1, steps % 3 == 0)


def test_the_oldest_steps_give_way_to_the_newest():
    buffer = ReplayBuffer(5, 2, 1)
    add(buffer, 0, 3)
    assert len(buffer) == 3
    add(buffer, 3, 7)  # wraps in the middle of what is added
    held = buffer[torch.arange(5)]
    assert len(buffer) == 5 and sorted(held.rewards.tolist()) == [20, 30, 40, 50, 60]


def test_every_step_keeps_its_own_successor_action_and_end():
    buffer = ReplayBuffer(8, 2, 1)
    for i in range(0, 20, 4):
        add(buffer, i, i + 4)
    batch = buffer.sample(200, torch.Generator().manual_seed(0))
    step = batch.rewards / 10
    assert torch.equal(batch.obs, torch.stack([step, step], 1)) and torch.equal(batch.next_obs, batch.obs + 1)
    assert torch.equal(batch.actions[:, 0], -step) and torch.equal(batch.terminated, step % 3 == 0)
    assert batch.terminated.dtype == torch.bool and set(step.tolist()) == set(range(12, 20))


def test_only_what_has_been_added_is_drawn_and_from_the_generator_alone():
    buffer = ReplayBuffer(100, 2, 1)
    add(buffer, 1, 4)
    torch.manual_seed(0)
    first = buffer.sample(50, torch.Generator().manual_seed(1))
    torch.manual_seed(1)
    again = buffer.sample(50, torch.Generator().manual_seed(1))
    assert torch.equal(first.rewards, again.rewards) and set(first.rewards.tolist()) == {10, 20, 30}


def test_what_was_drawn_does_not_change_when_the_buffer_does():
    buffer = ReplayBuffer(2, 2, 1)
    add(buffer, 0, 2)
    drawn = buffer[torch.tensor([0])]
    add(buffer, 7, 9)
    assert drawn.rewards.item() == 0


def test_it_goes_on_from_its_state():
    buffer, other = (ReplayBuffer(5, 2, 1) for _ in range(2))
    add(buffer, 0, 4)
    add(buffer, 4, 7)
    other.load_state_dict(buffer.state_dict())
    for one in (buffer, other):
        add(one, 7, 9)
    assert torch.equal(buffer.rows, other.rows) and buffer.added == other.added == 9


def test_impossible_sizes_are_refused():
    with pytest.raises(ValueError, match="capacity must be at least 1, got 0"):
        ReplayBuffer(0, 1, 1)
    with pytest.raises(ValueError, match="at most 2 rows"):
        add(ReplayBuffer(2, 2, 1), 0, 3)
