"""Frozen cases and messages survive their files and frames, and nothing else is read from them."""

import pickle

import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st

from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation
from course_lib.checks.stored import decode, encode, load, save

plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text().filter(lambda name: name != "@array"), inner),
    max_leaves=10,
)


@given(plain)
def test_plain_data_survives_a_frame(data):
    assert decode(encode(data)) == data


@pytest.mark.parametrize(
    "array", [torch.arange(6.0).double().reshape(2, 3), torch.tensor(1.5), torch.tensor([True, False]), torch.zeros(0, 2)]
)
def test_arrays_keep_shape_and_dtype(array):
    back = decode(encode({"a": array}))["a"]
    assert back.dtype == array.dtype and back.shape == array.shape and torch.equal(back, array)


def test_views_that_are_not_contiguous_survive():
    array = torch.arange(12.0).reshape(3, 4).T
    assert torch.equal(decode(encode([array]))[0], array)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"garbage",
        pickle.dumps({"a": 1}),
        b"\xff" * 100,
        (1 << 62).to_bytes(8, "little") + b"{}",
        safetensors.torch.save({"other": torch.zeros(1)}),
        safetensors.torch.save({"json": torch.frombuffer(bytearray(b'{"@array": "missing"}'), dtype=torch.uint8)}),
        safetensors.torch.save({"json": torch.frombuffer(bytearray(b"[" * 100_000), dtype=torch.uint8)}),
    ],
)
def test_anything_else_is_no_message(payload):
    with pytest.raises(ValueError, match="not a message"):
        decode(payload)


def test_an_exercise_survives_its_file(tmp_path):
    seen = Observation(kind="tensor", outputs={"": torch.tensor([1.0, torch.nan])}, gradients={"x": None, "y": torch.ones(2)})
    case = FrozenCase(
        "a case",
        {"x": torch.zeros(2, 1), "flag": torch.tensor([True]), "gamma": 0.5, "eps": float("inf")},
        [seen],
        {"wrong": seen},
        ["x"],
    )
    exercise = FrozenExercise(
        "f", {"values": 1.5, "errors": 0.5}, {"wrong": "look here"}, [case], {"wrong": ["values"]}, ["t"], True
    )
    save(tmp_path / "f.npz", exercise)
    back = load(tmp_path / "f.npz")
    assert (
        back.points == 2
        and back.messages == exercise.messages
        and back.signatures == exercise.signatures
        and back.axes == ["t"]
        and back.last_step_first
    )
    assert back.cases[0].arguments["eps"] == float("inf") and back.cases[0].arguments["flag"].dtype == torch.bool
    torch.testing.assert_close(back.cases[0].expected[0].outputs[""], seen.outputs[""], rtol=0, atol=0, equal_nan=True)
    assert back.cases[0].misconceptions["wrong"].gradients["x"] is None


def test_a_frozen_file_is_the_same_each_time(tmp_path):
    exercise = FrozenExercise("f", {"values": 1.0}, {}, [FrozenCase("c", {"x": torch.ones(3)}, [Observation()])])
    save(tmp_path / "a.npz", exercise)
    save(tmp_path / "b.npz", exercise)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
