"""The toy head is what other tests take it for: closed, outward, complete."""

import numpy as np
import pytest

from headbench.datasets.head.arrays import RING_REGIONS

from .toy import toy_head


@pytest.mark.parametrize("n", [16, 24, 32])
def test_closed_and_oriented(n):
    head = toy_head(n)
    assert len(head.template) == 13 * n + 2 + 2 * (2 * n + 2)
    edges = np.concatenate([head.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(edges, axis=0)) == len(edges)  # each direction once
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    a, b, c = np.moveaxis(head.template[head.faces], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 > 1e-3  # signed volume: normals point outwards


def test_complete_and_repeatable():
    head = toy_head(seed=5)
    for name in ("face", "lips", "neck", "scalp", "left_ear", "right_eyeball", "eye_region", *RING_REGIONS):
        assert len(head.regions[name]), name
    assert not set(head.regions["face"]) & set(head.regions["left_eyeball"])
    assert head.fingerprint() == toy_head(seed=5).fingerprint() != toy_head(seed=6).fingerprint()
    x = head.template[head.regions["left_eyeball"], 0]
    assert x.min() > 0
    with pytest.raises(ValueError, match="multiple of 8"):
        toy_head(20)
