"""The share of dynamic splats, of avatars made by hand whose ranges are known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import Changes
from headbench.bench.errors import UnavailableError
from headbench.bench.specs import Mechanism
from headbench.metrics.mechanism import dynamic_splats

LINES = Mechanism("lines", "opacity", "no-lines")
SIZES = np.array([0.0, 0.02, 0.03, 0.4])
HELD = np.array([True, True, True, False])


def measured(changes, poses=17):
    """The measurement of an avatar that changes by a function of the phase of a pose, over whole periods."""
    workload = [(None, phase) for phase in np.linspace(0, 4 * math.pi, poses)]
    return dynamic_splats(SimpleNamespace(changes=changes, render=print, files=print), workload)


def test_splats_count_whose_range_is_above_the_threshold():
    # A sine of amplitude a has the range 2 a, which is reached at a quarter and three quarters of a period.
    found = measured(lambda phase: Changes({"opacity": 0.5 + SIZES * math.sin(phase)}))
    assert found.value == 50
    assert found.details["opacity_range"] == pytest.approx(0.8)
    assert found.details["opacity_mean"] == pytest.approx(2 * SIZES.mean())
    assert (found.details["splats"], found.details["poses"]) == (4, 17)
    assert not {"dynamic_free", "dynamic_penalised"} & {*found.details}
    assert LINES.told(found.value) == "lines: opacity"


def test_quantities_join_and_have_units_of_their_own():
    def changes(phase):
        position = np.zeros((4, 3))
        position[:, 2] = [0, 0.2, 0.3, 0]  # ranges of 0.4 and 0.6 mm, against a threshold of 0.5 mm
        color = np.zeros((4, 3))
        color[3, 1] = 0.03
        return Changes({"position": 7 + position * math.sin(phase), "color": color * math.sin(phase)})

    found = measured(changes)
    assert found.value == 50
    assert found.details["position_range"] == pytest.approx(0.6)
    assert found.details["color_range"] == pytest.approx(0.06)


def test_penalised_splats_are_those_of_most_poses():
    def changes(phase):
        held = HELD if phase < 3 * math.pi else ~HELD
        return Changes({"opacity": SIZES * math.sin(phase)}, held)

    details = measured(changes).details
    assert details["dynamic_penalised"] == pytest.approx(100 / 3)
    assert details["opacity_range_penalised"] == pytest.approx(0.06)
    assert details["dynamic_free"] == 100
    assert details["opacity_mean_free"] == pytest.approx(0.8)


@pytest.mark.parametrize("values", [{}, {"opacity": np.full(3, 0.9)}, {"opacity": np.zeros(0)}])
def test_a_dead_mechanism_is_zero_and_off(values):
    found = measured(lambda phase: Changes(values, np.zeros(len(values.get("opacity", ())), bool)))
    assert (found.value, found.details.get("opacity_range", 0), found.details["dynamic_free"]) == (0, 0, 0)
    assert LINES.told(found.value) == "lines off: opacity"


def test_an_avatar_that_shows_no_mechanism_has_no_value():
    with pytest.raises(UnavailableError, match="no mechanism"):
        dynamic_splats(SimpleNamespace(render=print, files=print), [])
