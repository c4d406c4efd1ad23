"""Stand-ins for modules that official code imports but does not use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn


class PerceptualLoss(nn.Module):
    """Replaces the perceptual loss, whose weights are unavailable; calling it is an error."""

    def __init__(self, **options: Any):
        super().__init__()

    def forward(self, *images: Tensor) -> Tensor:
        """Raises `NotImplementedError`: runs that would use the loss are refused earlier."""
        raise NotImplementedError("the shim has no perceptual loss")


class Node:
    """``yacs``'s node of a configuration: attributes that are assigned."""

    def clone(self) -> Node:
        """The node with the same attributes."""
        copied = Node()
        copied.__dict__.update(self.__dict__)
        return copied


class Silent:
    """Ignores all calls, like a null logger."""

    def __init__(self, *arguments: Any, **options: Any):
        pass

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments, **options: None


OF_FLASHAVATAR: dict[str, dict[str, Any]] = {
    "yacs": {},
    "yacs.config": {"CfgNode": Node},
    "loguru": {"logger": Silent()},
    "skimage": {},
    "skimage.io": {"imread": None},
}
"""Stand-in modules for packages that are not installed, by name."""
REPLACED: dict[str, dict[str, Any]] = {"lpips": {"LPIPS": PerceptualLoss}}
"""Stand-ins used even if the package is installed: LPIPS downloads weights on construction."""
