"""Networks written out in NumPy are what torch.nn would compute, forwards and backwards; Adam is torch.optim's."""

import numpy as np
import pytest
import torch

from course_lib.control.networks import Adam, Networks, parameters


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def as_modules(networks):
    """The same networks in torch.nn."""
    modules = []
    for layers in networks.layers:
        parts = []
        for weight, bias in layers:
            linear = torch.nn.Linear(*weight.shape)
            with torch.no_grad():
                linear.weight.copy_(torch.from_numpy(weight.T.copy()))
                linear.bias.copy_(torch.from_numpy(bias.copy()))
            parts += [linear, torch.nn.ReLU()]
        modules.append(torch.nn.Sequential(*parts[:-1]))
    return modules


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("copies", [1, 2])
def test_outputs_and_all_gradients_are_those_of_torch_nn(copies, shared):
    networks = Networks((3, 8, 5, 2), copies, seeded())
    inputs = torch.randn(*(() if shared else (copies,)), 7, 3, generator=seeded(1), requires_grad=True)
    weighing = torch.randn(copies, 7, 2, generator=seeded(2))
    outputs = networks(inputs)
    to_weights, to_inputs = torch.autograd.grad((outputs * weighing).sum(), [networks.weights, inputs])

    modules = as_modules(networks)
    expected = torch.stack([module(inputs if shared else inputs[i]) for i, module in enumerate(modules)])
    torch.testing.assert_close(outputs, expected)
    weights = [parameter for module in modules for parameter in module.parameters()]
    *by_layer, expected_inputs = torch.autograd.grad((expected * weighing).sum(), [*weights, inputs])
    flat = torch.cat([(gradient.T if gradient.dim() > 1 else gradient).flatten() for gradient in by_layer])
    torch.testing.assert_close(to_weights, flat)
    torch.testing.assert_close(to_inputs, expected_inputs)


def test_without_learning_gradient_reaches_the_inputs_alone():
    networks = Networks((2, 4, 1), copies=2, generator=seeded())
    inputs = torch.ones(3, 2, requires_grad=True)
    networks(inputs, learn=False).sum().backward()
    assert networks.weights.grad is None and inputs.grad.abs().sum() > 0


def test_a_second_pass_does_not_change_the_gradient_of_the_first():
    networks = Networks((2, 4, 1), generator=seeded())
    one, other = torch.ones(3, 2), torch.randn(3, 2, generator=seeded(3))
    (alone,) = torch.autograd.grad(networks(one).sum(), networks.weights)
    first, second = networks(one).sum(), networks(other).sum()
    torch.autograd.grad(second, networks.weights)
    assert torch.equal(torch.autograd.grad(first, networks.weights)[0], alone)


def test_layers_are_views_so_that_a_step_in_place_changes_the_outputs():
    networks = Networks((2, 4, 1), generator=seeded())
    with torch.no_grad():
        networks.weights.zero_()
    assert networks(torch.ones(1, 2)).item() == 0


def test_copies_begin_apart_and_a_frozen_copy_stays_where_it_was():
    networks = Networks((2, 4, 1), copies=2, generator=seeded())
    first, second = networks.weights.detach().chunk(2)
    assert not torch.equal(first, second)
    frozen, before = networks.frozen_copy(), networks.weights.detach().clone()
    with torch.no_grad():
        networks.weights.add_(1)
    assert torch.equal(frozen.weights, before) and not frozen.weights.requires_grad
    assert networks.weights.abs().max() > 1 >= frozen.weights.abs().max()


def test_adam_is_that_of_torch_and_goes_on_from_its_state():
    start = torch.randn(6, generator=seeded())
    ours, theirs, resumed = (start.clone() for _ in range(3))
    theirs.requires_grad_()
    optimizer, reference = Adam(ours, 1e-2), torch.optim.Adam([theirs], 1e-2)
    for step in range(5):
        if step == 3:
            resumed.copy_(ours)
            continued = Adam(resumed, 1e-2)
            continued.load_state_dict(optimizer.state_dict())
        gradient = torch.randn(6, generator=seeded(step))
        optimizer.step(gradient)
        theirs.grad = gradient.clone()
        reference.step()
        if step >= 3:
            continued.step(gradient)
    torch.testing.assert_close(ours, theirs.detach())
    assert torch.equal(resumed, ours)


def test_parameters_share_no_memory_with_what_they_were_made_of():
    source = torch.ones(2)
    (made,) = parameters([source])
    assert made.requires_grad and made.data_ptr() != source.data_ptr()
    np.testing.assert_array_equal(made.detach(), source)
