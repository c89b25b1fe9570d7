import pytest
import torch

from autograder.authoring import parts


def _reference(x, y, scale=2.0):
    return scale * (x - y)


def test_a_formula_becomes_an_answer_with_the_references_parameters_and_defaults():
    answer = parts.versions_of(_reference)(lambda a, b, c: (a, b, c))
    assert answer(1, y=3) == (1, 3, 2.0)
    assert answer(y=3, x=1, scale=5.0) == (1, 3, 5.0)
    with pytest.raises(TypeError):
        answer(1)


def test_its_checks_name_what_they_refuse_unless_they_are_left_out():
    version = parts.versions_of(_reference, parts.one_shape("x", "y"), parts.satisfies(lambda scale, x: scale > len(x)))
    one, two = torch.zeros(1), torch.zeros(2)
    with pytest.raises(ValueError, match=r"'x': \(1,\), 'y': \(2,\)"):
        version(_reference)(one, two)
    with pytest.raises(ValueError, match="scale and x"):
        version(_reference)(two, two)
    assert version(_reference)(one, one).shape == (1,)
    assert version(_reference, checked=False)(one, two).shape == (2,)


def test_data_is_detached_unless_it_leaks_and_the_rest_keeps_its_graph():
    version = parts.versions_of(_reference, data=["y", "scale"])
    x, y = (torch.ones(3, requires_grad=True) for _ in range(2))
    for leak, reached in ((False, False), (True, True)):
        gradients = torch.autograd.grad(version(_reference, leak=leak)(x, y).sum(), [x, y], allow_unused=True)
        assert gradients[0] is not None and (gradients[1] is not None) == reached


def test_a_table_of_formulas_becomes_misconceptions_in_its_order():
    table = {"doubled": (lambda x, y, scale: 2 * x, "Not twice."), "swapped": (lambda x, y, scale: y, "The other one.")}
    found = parts.wrong(table, parts.versions_of(_reference))
    assert [(one.name, one.message, one.function(3, 4)) for one in found] == [
        ("doubled", "Not twice.", 6),
        ("swapped", "The other one.", 4),
    ]
    assert parts.wrong({"as it is": (_reference, "…")})[0].function is _reference


def test_what_is_drawn_depends_on_the_settings_and_the_generator_alone():
    inputs = parts.drawing(lambda generator, size=2: {"x": parts.normal(generator, size)})
    first, again = (inputs(size=5)(torch.Generator().manual_seed(7))["x"] for _ in range(2))
    assert first.shape == (5,) and torch.equal(first, again)
    assert inputs()(torch.Generator().manual_seed(7))["x"].shape == (2,)


def test_a_known_number_is_a_scalar_and_several_are_a_vector():
    assert parts.number(0.5)(x=1).shape == () and parts.number(0.5, 0.25)(x=1).tolist() == [0.5, 0.25]


def test_altered_inputs_are_made_from_the_others_of_the_same_draw():
    inputs = parts.altered(
        parts.drawing(lambda generator: {"x": parts.normal(generator, 3), "n": 2})(), lambda d: {"y": d["n"] * d["x"]}
    )
    drawn = inputs(torch.Generator().manual_seed(7))
    assert list(drawn) == ["x", "n", "y"] and torch.equal(drawn["y"], 2 * drawn["x"])


def test_rows_are_cut_to_the_shortest_and_single_ones_repeated():
    given = (torch.arange(6).reshape(3, 2), torch.arange(5), torch.ones(1, 2), 0.5)
    x, y, single, scalar = parts.rows_cut(lambda *cut: cut)(*given)
    assert x.tolist() == [[0, 1], [2, 3], [4, 5]] and y.tolist() == [0, 1, 2]
    assert single.tolist() == [[1, 1]] * 3 and scalar == 0.5
    assert parts.rows_cut(lambda one: one)(torch.ones(1)).tolist() == [1]


def test_a_right_answer_is_spoilt_in_each_way_asked_for_and_in_place_only_where_an_argument_is_named():
    named = parts.spoilt(_reference, parts.dtype_lost, parts.python_float, changed="y")
    assert [mistake.name for mistake in named] == ["dtype-lost", "python-float", "input-changed"]
    x, y = torch.ones((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    assert named[0].function(x, y).dtype == torch.float32 and named[1].function(x, y) == 0.0
    named[2].function(x, y)
    named[2].function(x=x, y=y)
    assert (x, y) == (1.0, 0.25)
    assert parts.spoilt(_reference, parts.dtype_lost)[0].name == "dtype-lost" and not parts.spoilt(_reference)


def test_a_misshapen_argument_is_to_be_refused_by_its_name_unless_others_are_given():
    inputs = parts.drawing(lambda generator: {"x": parts.normal(generator, 3), "y": parts.normal(generator, 3)})()
    case = parts.misshapen("y as a column", inputs, "y", lambda y: y[:, None], visible=True, draws=1)
    drawn = case.inputs(torch.Generator().manual_seed(7))
    assert (drawn["x"].shape, drawn["y"].shape) == ((3,), (3, 1))
    assert (case.name, case.raises, case.facet, case.visible, case.draws) == ("y as a column", ["y"], "errors", True, 1)
    assert parts.misshapen("y as a column", inputs, "y", lambda y: y[:, None], ("x", "y")).raises == ("x", "y")


def test_an_argument_of_any_kind_can_be_changed_in_place():
    for given in (torch.ones(2), torch.ones(2, dtype=torch.int64), torch.ones(2, dtype=torch.bool)):
        before = given.clone()
        parts.in_place(lambda x: x.sum(), "x").function(given)
        assert not torch.equal(given, before)
