"""The separate tongue of heads that bring none: it comes out of the mouth, not through the lip."""

from pathlib import Path

import numpy as np
import pytest
import torch

from headbench.datasets.head.model import HeadModel
from headbench.datasets.synthetic.anatomy import front_depth, measure, person
from headbench.datasets.synthetic.take import load_geometry

ICT = Path(__file__).parents[3].parent / "shared/data/ict_facekit/ict_facekit_f16.npz"


@pytest.mark.parametrize("share", [0.5, 0.75, 1.0])
def test_tongue_slides_over_the_lower_lip(share):
    if not ICT.exists():
        pytest.skip("no ICT-FaceKit file beside the repository")
    geometry = load_geometry(str(ICT))
    head = geometry.head
    shape = np.zeros(head.shape_basis.shape[2])
    neutral = HeadModel(head, dtype=torch.float64).canonical(torch.from_numpy(shape))[0].numpy()
    anatomy = measure(head, neutral)
    (tongue,) = geometry.mouth(person("900", 0, 1), anatomy, shape)
    step, size = 0.0005, np.array([80, 90])
    low = anatomy["mouth"][:2] - [0.020, 0.040]
    skin = front_depth(neutral, anatomy.skin_faces, low, step, size)
    hidden = front_depth(tongue.at(share), tongue.faces, low, step, size) > skin
    rim = 80  # row at the height where the lips meet
    middle = hidden[:rim, 40]
    assert middle.any()
    lowest = int(np.flatnonzero(middle)[0])
    assert middle[lowest : rim - 4].all(), "skin shows between the mouth's opening and the tongue's tip"
