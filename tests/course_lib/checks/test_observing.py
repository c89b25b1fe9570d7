"""What an observation holds: values, gradients, graphs, dtypes, changed inputs, exceptions."""

import warnings

import torch

from course_lib.checks.cases import Observation, built
from course_lib.checks.observing import observe

X = {"x": torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), "scale": 2.0}


def test_a_tensor_and_its_gradient():
    seen = observe(lambda x, scale: scale * x, X, ["x"])
    assert seen.kind == "tensor" and seen.outputs[""].tolist() == [2, 4, 6] and seen.graph == [""]
    torch.testing.assert_close(seen.gradients["x"], 2 * torch.arange(3.0, dtype=torch.float64).cos())


def test_a_detached_result_has_no_gradient_and_no_graph():
    seen = observe(lambda x, scale: (scale * x).detach(), X, ["x"])
    assert seen.gradients == {"x": None} and seen.graph == []


def test_a_gradient_of_zeros_counts_as_none():
    assert observe(lambda x, scale: x * 0, X, ["x"]).gradients == {"x": None}


def test_tuples_and_dicts_are_taken_apart():
    assert list(observe(lambda x, scale: (x, x + 1), X).outputs) == ["0", "1"]
    assert observe(lambda x, scale: {"b": x, "a": x}, X).kind == "dict of a, b"


def test_other_results_are_named_by_type():
    assert observe(lambda x, scale: 3.0, X) == Observation(kind="float", outputs={"": torch.tensor(3.0)})
    assert observe(lambda x, scale: None, X).kind == "NoneType"


def test_changed_inputs_are_noticed_even_if_they_require_gradient():
    def in_place(x, scale):
        x += 1
        return x

    assert observe(in_place, X).mutated == ["x"]
    assert observe(in_place, X, ["x"]).mutated == ["x"]
    assert X["x"].tolist() == [1, 2, 3]


def test_an_exception_is_observed_not_raised():
    def broken(x, scale):
        raise IndexError("no such step")

    seen = observe(broken, X)
    assert (seen.error, seen.message) == ("IndexError", "no such step")


def test_an_exception_without_a_text_is_still_observed():
    class Rude(Exception):
        def __str__(self):
            raise RuntimeError

    def broken(x, scale):
        raise Rude

    assert observe(broken, X).error == "Rude"


def test_renamed_parameters_go_by_position():
    assert observe(lambda tensor, factor: tensor * factor, X).outputs[""].tolist() == [2, 4, 6]


def test_a_warning_costs_nothing():
    def noisy(x, scale):
        warnings.warn("deprecated", stacklevel=1)
        return x

    assert observe(noisy, X).error == ""


def test_a_graph_broken_in_place_gives_no_number_for_a_gradient():
    def broken(x, scale):
        y = x.exp()
        z = y * y
        y += 1
        return z

    assert observe(broken, X, ["x"]).gradients["x"].isnan().all()


def test_single_precision_inputs_stay_single():
    assert observe(lambda x: x, {"x": torch.zeros(2)}).outputs[""].dtype == torch.float32


def test_flags_and_indices_keep_their_dtypes():
    kinds = {}
    observe(
        lambda mask, ids: kinds.update(mask=mask.dtype, ids=ids.dtype), {"mask": torch.tensor([True]), "ids": torch.tensor([3])}
    )
    assert kinds == {"mask": torch.bool, "ids": torch.int64}


def test_nested_results_are_flattened_to_paths():
    seen = observe(lambda x, scale: (x, {"entropy": x.mean(), "steps": 3}), X)
    assert seen.kind == "tuple of 2 (tensor, dict of entropy, steps (int))"
    assert list(seen.outputs) == ["0", "1.entropy", "1.steps"]


def test_generators_are_consumed_and_go_on_from_call_to_call():
    def orders(count, generator):
        yield from torch.randperm(count, generator=generator).split(2)

    arguments = {"count": 4, "generator": built("seeding.generator", seed=3)}
    once, twice = observe(orders, arguments), observe(orders, arguments, repeat=2)
    assert once.kind == "tuple of 2" and list(twice.outputs) == ["0.0", "0.1", "1.0", "1.1"]
    assert once.outputs["0"].tolist() == twice.outputs["0.0"].tolist() != twice.outputs["1.0"].tolist()


def test_an_endless_iterator_ends():
    def endless():
        while True:
            yield 1.0

    assert len(observe(endless, {}).outputs) == 10_000


def test_arguments_can_be_looked_at_after_the_call():
    def halve(target, online):
        for one in target:
            one.mul_(0.5)

    arguments = {"target": [torch.ones(2), torch.zeros(1)], "online": [torch.ones(2), torch.zeros(1)]}
    seen = observe(halve, arguments, returns=["target"])
    assert seen.outputs["0"].tolist() == [0.5, 0.5] and seen.mutated == []
    assert observe(halve, arguments).mutated == ["target"]


def test_what_is_built_is_built_anew_for_every_observation():
    def step(envs, actions):
        return torch.as_tensor(envs.step(actions.numpy())[0])

    arguments = {"envs": built("control.envs.ChainVectorEnv", num_envs=2, slip=0.0), "actions": torch.tensor([1, 0])}
    assert observe(step, arguments).outputs[""].tolist() == observe(step, arguments).outputs[""].tolist()


def test_a_generators_state_can_be_looked_at():
    given = {"generator": built("seeding.generator", seed=3)}
    seen = observe(lambda generator: torch.rand(2, generator=generator), given, returns=["generator"])
    expected = torch.Generator().manual_seed(3)
    torch.rand(2, generator=expected)
    assert torch.equal(seen.outputs[""], expected.get_state())


def test_what_is_drawn_from_torchs_own_generator_is_the_same_each_time_and_leaves_no_trace():
    torch.manual_seed(7)
    before = torch.get_rng_state()
    first, again = (observe(lambda: torch.rand(3), {}, repeat=2) for _ in range(2))
    assert torch.equal(first.outputs["0"], again.outputs["0"]) and torch.equal(first.outputs["1"], again.outputs["1"])
    assert not torch.equal(first.outputs["0"], first.outputs["1"])
    assert torch.equal(torch.get_rng_state(), before)


def test_lazy_results_draw_from_torchs_own_generator_too():
    def batches():
        for _ in range(2):
            yield torch.rand(())

    assert observe(batches, {}) == observe(batches, {})
