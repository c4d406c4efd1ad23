import pytest

from headbench.bench.errors import UnavailableError
from headbench.metrics.training import training_iterations, training_memory, training_processor, training_time

RECORD = {
    "seconds": 150.0,
    "interruptions": 0,
    "peak_memory_bytes": 1_500_000_000,
    "memory_before_bytes": 400_000_000,
    "processor_seconds": 280.5,
    "method": {"budget": {"iterations": 4000, "seconds": None}},
}


def test_time_in_minutes_and_memory_in_si_gigabytes():
    assert training_time(RECORD).value == 2.5
    measured = training_memory(RECORD)
    assert measured.value == 1.5
    assert measured.details == {"bytes": 1.5e9, "before_bytes": 4e8}


def test_processor_time_and_iterations_are_those_of_the_record():
    assert training_processor(RECORD).value == 280.5
    assert training_iterations(RECORD).value == 4000


@pytest.mark.parametrize("iterations", [None, 100_000])
def test_a_limit_of_seconds_leaves_iterations_unknown(iterations):
    with pytest.raises(UnavailableError, match="in seconds"):
        training_iterations({"method": {"budget": {"iterations": iterations, "seconds": 60.0}}})


def test_an_interrupted_training_has_no_time_but_a_memory():
    interrupted = {**RECORD, "interruptions": 2}
    for metric in (training_time, training_processor):
        with pytest.raises(UnavailableError, match="interrupted 2 times"):
            metric(interrupted)
    assert training_memory(interrupted).value == 1.5


@pytest.mark.parametrize("metric", [training_time, training_memory, training_processor])
def test_a_record_that_does_not_tell_is_said(metric):
    with pytest.raises(UnavailableError, match="has no"):
        metric({})
