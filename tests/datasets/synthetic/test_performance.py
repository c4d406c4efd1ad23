import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.synthetic.performance import (
    BEYOND,
    CONTROLS,
    EXPRESSION_CONTROLS,
    FREE_PARTS,
    HELD_OUT,
    SEQUENCES,
    perform,
    share_out,
)


@pytest.mark.parametrize("timesteps", [4, 8, 15, 16, 60, 300])
def test_timesteps_are_shared_out_exactly(timesteps):
    shares = share_out(timesteps)
    assert sum(shares.values()) == timesteps
    assert HELD_OUT in shares
    assert len(shares) >= 2
    assert min(shares.values()) >= 2
    assert timesteps < 300 or list(shares) == list(SEQUENCES)


@pytest.mark.parametrize("timesteps", [60, 400])
def test_a_performance_in_parts_has_every_sequence(timesteps):
    with pytest.raises(InputError, match="at least 59"):
        share_out(20, "parts")
    shares = share_out(timesteps, "parts")
    assert sum(shares.values()) == timesteps
    assert set(shares) == set(SEQUENCES) - {HELD_OUT} | set(FREE_PARTS)
    assert min(shares.values()) >= 2
    held = sum(count for name, count in shares.items() if name.startswith(HELD_OUT))
    assert held == pytest.approx(0.25 * timesteps, abs=1)


def test_parts_of_free_are_further_and_further_from_training():
    def controls(names):
        played = [a for name in names for a in perform(name, 200, seed=1).activations]
        return np.array([[a[control] for control in EXPRESSION_CONTROLS] for a in played])

    train = controls(name for name in SEQUENCES if name != HELD_OUT)
    assert train.max(0).min() > 0.5  # every control is trained
    seen, recombined, beyond = (controls([name]) for name in FREE_PARTS)
    near = [
        np.linalg.norm(part[:, None] - train[None], axis=2).min(1).mean()
        for part in (seen, recombined, beyond)
    ]
    assert near[0] < 0.7 * min(near[1:])
    assert (recombined <= train.max(0) + 0.05).all()
    assert (beyond > train.max(0) + 0.05).any(1).mean() > 0.1


@pytest.mark.parametrize("name", [*SEQUENCES, *FREE_PARTS])
def test_curves_are_bounded_smooth_and_repeatable(name):
    played = perform(name, 400, seed=1)
    values = np.array([[a[control] for control in CONTROLS] for a in played.activations])
    assert np.isfinite(values).all()
    assert np.abs(values).max() <= (BEYOND + 0.05 if name == "FREE-3-beyond" else 1.3)
    # No jumps: about 40 moments a second, and a blink closes in about 80 ms.
    assert np.abs(np.diff(values, axis=0)).max() < 0.5
    again = perform(name, 400, seed=1).activations
    assert again == played.activations
    assert perform(name, 400, seed=2).activations != played.activations


def test_tongue_is_out_in_free_alone_and_labelled_exactly_there():
    for name in SEQUENCES:
        played = perform(name, 120, seed=0, tongue_shows=0.5)
        out = {t for t, a in enumerate(played.activations) if a["tongue_out"] >= 0.5}
        assert set(played.excluded) == out
        assert all("tongue" in reason for reason in played.excluded.values())
        assert bool(out) == (name == HELD_OUT)
        assert len(out) < 60


@pytest.mark.parametrize("name", SEQUENCES)
def test_performance_kinds_mute_controls_and_keep_the_others(name):
    full = perform(name, 60, seed=3).activations
    jaw = {"jaw_open", "jaw_side", "tongue_out"}
    for kind, muted in (("expressions", jaw), ("still", jaw | set(EXPRESSION_CONTROLS))):
        played = perform(name, 60, seed=3, kind=kind)
        assert not played.excluded
        for before, after in zip(full, played.activations):
            assert after == {control: 0.0 if control in muted else before[control] for control in CONTROLS}
