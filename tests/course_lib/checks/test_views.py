"""Views: what all right answers have in common, and what they make of anything else."""

import numpy as np
import pytest
import torch

from course_lib.checks import views

SIZES = {"batch_size": 6, "minibatch_size": 4, "generator": {"@built": "seeding.generator", "arguments": {"seed": 5}}}


def seen(*orders, cuts=(4,)):
    """The view of epochs with these orders, cut into batches."""
    batches = [np.split(np.array(order, dtype=np.int64), cuts) for order in orders]
    outputs = {f"{e}.{b}": batch for e, found in enumerate(batches) for b, batch in enumerate(found)}
    return {name: value.tolist() for name, value in views.epochs(SIZES, outputs).items()}


def test_two_permutations_look_alike():
    first, second = seen([3, 1, 0, 5, 2, 4], [5, 0, 4, 1, 3, 2]), seen([2, 5, 1, 3, 0, 4], [4, 0, 2, 5, 1, 3])
    assert first == second
    assert first["0.sizes"] == [4, 2] and not first["0.twice"] and not first["0.missing"] and first["int64"]


@pytest.mark.parametrize(
    ("order", "flag"),
    [
        ([0, 1, 2, 3, 4, 5], "in_order"),
        ([2, 0, 3, 1, 5, 4], "neighbours_only"),
        ([3, 1, 0, 3, 2, 4], "twice_in_a_batch"),
        ([3, 1, 0, 5, 3, 4], "twice"),
        ([3, 1, 0, 5, 2, 3], "missing"),
        ([3, 1, 0, 6, 2, 4], "out_of_range"),
    ],
)
def test_what_is_no_random_order_is_told(order, flag):
    assert seen(order)[f"0.{flag}"]


def test_epochs_with_one_order_are_told():
    assert seen([3, 1, 0, 5, 2, 4], [3, 1, 0, 5, 2, 4])["one_order"]
    assert not seen([3, 1, 0, 5, 2, 4])["one_order"]  # of a single epoch one cannot know


@pytest.mark.parametrize(
    "outputs",
    [{}, {"0": np.arange(6)}, {"0.0": np.arange(6.0)}, {"0.0": np.zeros((2, 3), int)}, {"0.0.0": np.array(1)}],
)
def test_what_is_no_epoch_is_refused(outputs):
    with pytest.raises(ValueError):
        views.epochs(SIZES, outputs)


def test_width_of_an_interval():
    found = views.width({}, {"0": np.array(1.5), "1": np.array(4.0)})["width"]
    assert isinstance(found, np.ndarray) and found == 2.5  # a file of frozen cases has no place for NumPy's scalars
    for unreadable in ({"0": np.array(1.0)}, {"0": np.array(1), "1": np.array(2)}, {"0": np.ones(1), "1": np.ones(1)}):
        with pytest.raises(ValueError):
            views.width({}, unreadable)


def test_whether_a_generator_was_drawn_from():
    generator = torch.Generator().manual_seed(5)
    assert not views.drawn_from(SIZES, {"": generator.get_state().numpy()})["drawn"]
    torch.rand((), generator=generator)
    assert views.drawn_from(SIZES, {"": generator.get_state().numpy()})["drawn"]


def test_of_an_optimiser_its_steps():
    assert views.steps_made({}, {"steps": np.array(3), "moments.0": np.ones(4)}) == {"steps": 3}
    with pytest.raises(ValueError):
        views.steps_made({}, {"moments.0": np.ones(4)})


KINDS = {"true_returns_a": np.repeat([1.0, 2.0, 2.0], 4), "true_returns_b": np.repeat([0.0, 2.0, 1.0], 4)}


def test_answers_are_counted_by_kind_of_pair():
    answers = np.array([1, 1, 1, 1, 1, 0, 0, 1, 0, 0, 0, 1], dtype=bool)
    once = views.group_frequencies(KINDS, {"": answers})
    assert once["frequency"].tolist() == [1, 0.5, 0.25] and not once["alike"]
    assert views.group_frequencies(KINDS, {"0": answers, "1": answers})["alike"]
    twice = views.group_frequencies(KINDS, {"0": answers, "1": ~answers})
    assert twice["frequency"].tolist() == [0.5, 0.5, 0.5] and not twice["alike"]


@pytest.mark.parametrize("answers", [np.ones(12), np.ones(3, dtype=bool), np.ones((12, 1), dtype=bool)])
def test_answers_that_are_no_bools_for_each_pair_cannot_be_read(answers):
    with pytest.raises(ValueError, match="bool tensor of shape"):
        views.group_frequencies(KINDS, {"": answers})


def test_no_answers_cannot_be_read():
    with pytest.raises(ValueError, match="bool tensor"):
        views.group_frequencies(KINDS, {})


def imagined(continues, fill=7.0):
    """Trajectories of two numbers a state and one an action, all of them `fill`, with these `continues` (H, B)."""
    continues = np.array(continues, dtype=float)
    steps, batch = continues.shape
    shapes = {"obs": (steps + 1, batch, 2), "actions": (steps, batch, 1), "rewards": (steps, batch)}
    return {name: np.full(shape, fill) for name, shape in shapes.items()} | {"continues": continues}


def test_what_comes_after_an_end_does_not_count_and_what_led_to_it_does():
    kept = views.until_the_end({}, imagined([[1, 1], [0, 1], [0, 1]]))
    assert (kept["obs"][:, :, 0] != 0).tolist() == [[True, True], [True, True], [True, True], [False, True]]
    assert (
        (kept["actions"][:, :, 0] != 0).tolist() == (kept["rewards"] != 0).tolist() == [[True, True], [True, True], [False, True]]
    )
    assert kept["continues"].tolist() == [[1, 1], [0, 1], [0, 1]]


def test_whoever_comes_back_to_life_is_seen():
    assert views.until_the_end({}, imagined([[0], [1]]))["continues"].tolist() == [[0], [1]]


def test_imagined_entries_of_shapes_that_do_not_fit_are_left_alone_and_others_cannot_be_read():
    outputs = imagined([[1, 1], [0, 1]]) | {"rewards": np.ones(3)}
    assert all(views.until_the_end({}, outputs)[name] is outputs[name] for name in outputs)
    with pytest.raises(ValueError, match="obs, actions, rewards, continues"):
        views.until_the_end({}, {"obs": np.ones(3)})


def clips_numbered(*numbers):
    return {"arguments": {"actions": np.array(numbers, dtype=float).reshape(-1, 1, 1)}}


TRAINING = {
    "training_pairs": [clips_numbered(0, 2, 4), clips_numbered(1, 3, 5)],
    "held_out_pairs": [clips_numbered(6), clips_numbered(7)],
    "num_epochs": 2,
}


def diary_of(*steps):
    """A diary of minibatches of clips, one after another."""
    return np.array([(clip, step) for step, clips in enumerate(steps) for clip in clips])


def test_a_right_training_is_one_whatever_its_order():
    seen = [
        views.diary_of_training(TRAINING, {"diary": diary_of(*steps)})
        for steps in ([(0, 4, 1, 5), (2, 3), (2, 4, 3, 5), (0, 1)], [(3, 1, 2, 0), (5, 4), (1, 0, 5, 4), (3, 2)])
    ]
    assert {name: value.item() for name, value in seen[0].items()} == {
        "steps": 4,
        "a clip's times at least": 2,
        "a clip's times at most": 2,
        "held-out clips were learned from": False,
        "the clips of a pair were apart": False,
        "the same minibatches in each epoch": False,
        "neighbours only": False,
    }
    assert {name for name in seen[0] if seen[0][name] != seen[1][name]} == set()


@pytest.mark.parametrize(
    ("steps", "name"),
    [
        ([(0, 4, 1, 5), (2, 3), (2, 4, 3, 5), (0, 1, 6, 7)], "held-out clips were learned from"),
        ([(0, 4, 1, 3), (2, 5), (2, 4, 3, 5), (0, 1)], "the clips of a pair were apart"),
        ([(0, 4, 1, 5), (2, 3)] * 2, "the same minibatches in each epoch"),
        ([(0, 2, 1, 3), (4, 5), (2, 4, 3, 5), (0, 1)], "neighbours only"),
    ],
)
def test_mistakes_of_a_training_are_seen(steps, name):
    assert views.diary_of_training(TRAINING, {"diary": diary_of(*steps)})[name]


def test_without_a_diary_or_weights_nothing_is_seen():
    for outputs in ({}, {"diary": np.zeros((0, 2))}, {"diary": np.zeros(3)}):
        with pytest.raises(ValueError, match="nothing was learned"):
            views.diary_of_training(TRAINING, outputs)
    with pytest.raises(ValueError, match="no weights"):
        views.weights_learned({}, {"diary": np.zeros(3)})


def test_habits_of_a_table():
    table = np.zeros((4, 4))
    arguments = {"reference": {"arguments": {"table": table}}, "score": {"arguments": {"token": 1}}}

    def habits(changed):
        return [bool(seen) for seen in views.habits_of_a_table(arguments, {"policy.table": changed}).values()]

    liking, nearly = table.copy(), table.copy()
    liking[:, 1] += 3
    nearly[:, 1] += 0.1
    assert (habits(liking), habits(nearly), habits(-liking)) == ([True, False], [False, True], [False, False])
    with pytest.raises(ValueError, match="no policy's table"):
        views.habits_of_a_table(arguments, {})


def test_losses_and_logs_are_seen_in_double_precision():
    column = np.ones(3, dtype=np.float32)
    assert views.losses_seen({}, {"": column})["losses"].dtype == np.float64
    assert views.log_of_steps({}, {"loss": column, "accuracy": column})["accuracy"].dtype == np.float64


@pytest.mark.parametrize("outputs", [{}, {"0": np.ones(())}, {"": np.ones(())}, {"": np.ones(3, dtype=int)}])
def test_what_is_no_tensor_of_losses_is_refused(outputs):
    with pytest.raises(ValueError, match="one tensor of numbers"):
        views.losses_seen({}, outputs)


@pytest.mark.parametrize("outputs", [{}, {"0.loss": np.ones(3)}, {"loss": np.ones(3, dtype=int)}])
def test_what_is_no_log_is_refused(outputs):
    with pytest.raises(ValueError, match="dict of tensors"):
        views.log_of_steps({}, outputs)
