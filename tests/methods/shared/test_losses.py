"""The regularisers of splat training."""

import torch

from headbench.methods.shared.losses import position_penalty, scale_penalty


def test_penalties_have_zero_gradient_where_nothing_exceeds():
    means = torch.zeros(4, 3, requires_grad=True)
    log_scales = torch.full((4, 3), -5.0, requires_grad=True)
    visible = torch.ones(4, dtype=torch.bool)
    (position_penalty(means, visible, 1.0) + scale_penalty(log_scales, visible, 0.6)).backward()
    assert (means.grad == 0).all()
    assert (log_scales.grad == 0).all()
    assert float(position_penalty(means.detach() + 9, ~visible, 1.0)) == 0  # nothing visible costs nothing
