"""How much memory a test may take."""

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def memory_below(most: float) -> Iterator[None]:
    """Fail where the block takes ``most`` bytes at once or more, by Python and numpy, also where it raises."""
    tracemalloc.start()
    try:
        yield
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < most
