"""A file is read strictly, and flies the same wherever it does."""

import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import safetensors.numpy

from course_lib.control import flight, policies

LANDER = flight.TASKS["lander"]


@pytest.fixture(scope="module")
def weights():
    """A policy that fires its engines at random, and differently in every state."""
    generator = np.random.default_rng(0)
    tensors = {name: generator.normal(0, 0.5, shape).astype(np.float32) for name, shape in LANDER.tensors.items()}
    return tensors | {"obs_std": np.ones(8, np.float32)}


def refusal(content):
    with pytest.raises(flight.RefusedFile) as caught:
        flight.read_weights(content, LANDER)
    return str(caught.value)


def test_what_was_written_is_read(weights):
    content = safetensors.numpy.save(weights, {"trained": "by me"})
    read = flight.read_weights(content, LANDER)
    assert read.keys() == weights.keys() and all(np.array_equal(read[name], weights[name]) for name in weights)
    assert len(content) < flight.MAX_BYTES / 4


@pytest.mark.parametrize("length", [0, 1, 7, 8, 9, 500, 30_000])
def test_a_part_of_a_file_is_refused(weights, length):
    assert "it is no safetensors file, or only a part of one" in refusal(safetensors.numpy.save(weights)[:length])


@pytest.mark.parametrize("table", ["null", "3", "[]", '"x"', "{", "NaN", '{"log_std":' * 5000, "9" * 5000])
def test_a_table_that_is_no_table_is_refused(table):
    assert "it is no safetensors file" in refusal(len(table).to_bytes(8, "little") + table.encode())


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (3, "log_std has the dtype None where F32"),
        ({"dtype": ["F32"], "shape": [2]}, "log_std has the dtype ['F32'] where F32"),
        ({"dtype": "F32", "shape": 2}, "log_std has the shape 2 where [2] belongs"),
        ({"dtype": "F32", "shape": [2], "data_offsets": [0, 1 << 70]}, "it is no safetensors file"),
        ({"dtype": "F32", "shape": [2], "data_offsets": [8, 0]}, "it is no safetensors file"),
        ({"dtype": "F32", "shape": [2.0], "data_offsets": [0, 8]}, "it is no safetensors file"),
    ],
)
def test_an_entry_that_is_none_is_refused(weights, entry, message):
    content = safetensors.numpy.save(weights)
    length = int.from_bytes(content[:8], "little")
    table = json.dumps(json.loads(content[8 : 8 + length]) | {"log_std": entry}).encode()
    assert message in refusal(len(table).to_bytes(8, "little") + table + content[8 + length :])


def test_a_missing_tensor_is_named(weights):
    some = {name: tensor for name, tensor in weights.items() if name != "actor.out.bias"}
    assert refusal(safetensors.numpy.save(some)).startswith("it lacks actor.out.bias; the task's policy has actor.0.weight, ")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_refused(weights, value):
    changed = weights | {"log_std": np.array([0, value], np.float32)}
    assert "log_std holds numbers that are not finite" in refusal(safetensors.numpy.save(changed))


def test_a_large_file_is_not_parsed():
    assert refusal(b"x" * (flight.MAX_BYTES + 1)) == "it is larger than 256 kB, and the task's policy needs 37 kB"


def test_a_policy_of_the_course_is_read_and_acts_as_it_does_itself(tmp_path):
    policy = policies.make_policy(**policies.LANDER, log_std=-1.0, seed=3)
    policy.tensors()["actor.out.weight"].mul_(500)  # a new policy does almost nothing
    policy.obs_mean[:] = 0.3
    policy.obs_std[:] = 1.7
    policies.save_policy(policy, tmp_path / "policy.safetensors")
    obs = np.random.default_rng(0).normal(size=(500, 8)).astype(np.float32)
    seen = flight.act(flight.read_weights((tmp_path / "policy.safetensors").read_bytes(), LANDER), obs)
    wanted = policy.best_action(obs).numpy().clip(-1, 1)
    assert 0.1 < np.mean(np.abs(wanted) == 1) < 0.9  # so that both what is clipped and what is not are seen
    np.testing.assert_allclose(seen, wanted, atol=1e-4)


def test_the_largest_weights_give_finite_actions(weights):
    largest = {name: np.sign(tensor) * np.finfo(np.float32).max for name, tensor in weights.items()}
    largest |= {"obs_std": np.full(8, 1e-45, np.float32)}
    with np.errstate(all="raise", under="ignore"):
        actions = flight.act(largest, np.random.default_rng(0).normal(0, 1000, (50, 8)).astype(np.float32))
    assert actions.dtype == np.float32 and np.abs(actions).max() <= 1


def test_an_episode_is_the_same_in_any_company_and_in_a_process_of_its_own(weights):
    seeds = [7, 2**31 - 1, 0, 7]
    together = flight.fly(weights, seeds, LANDER)
    assert together[0] == together[3] and len(set(together)) == 3
    assert [flight.fly(weights, [seed], LANDER)[0] for seed in seeds[:3]] == together[:3].tolist()
    command = [sys.executable, "-I", flight.__file__, "lander", *map(str, seeds)]
    alone = subprocess.run(command, input=safetensors.numpy.save(weights), capture_output=True, check=True)
    assert json.loads(alone.stdout) == {"returns": together.tolist()} and alone.stderr == b""


def test_returns_are_those_of_the_environment_flown_by_hand(weights):
    env = gymnasium.make(LANDER.environment)
    obs, _ = env.reset(seed=3)
    total, over = 0.0, False
    while not over:
        obs, reward, terminated, truncated, _ = env.step(flight.act(weights, obs[None])[0])
        total, over = total + reward, terminated or truncated
    assert flight.fly(weights, [3], LANDER)[0] == pytest.approx(total)


def test_the_grader_flies_without_torch():
    code = f"import runpy, sys; runpy.run_path({flight.__file__!r}); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-I", "-c", code], check=True)
