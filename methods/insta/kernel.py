"""The compiled kernel: nearest triangles, ray marching, hash encoding. Every part has a reference implementation in torch."""

from __future__ import annotations

from ...bench.native.dispatch import Kernel

KERNEL = Kernel(
    "headbench.methods.insta._kernel", "INSTA's kernel", "the reference works meanwhile, very slowly"
)
load = KERNEL.load_or_warn
