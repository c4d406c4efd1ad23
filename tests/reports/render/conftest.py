"""The ball avatars, which have known pictures."""

from ...bench.experiments.conftest import ball_run, balls, run_of  # noqa: F401
