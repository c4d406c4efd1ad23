"""A run that is killed before a write and started again gives the rows of an unbroken one, and leaves nothing else."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.engine import run as runner


def killed_before(number, work):
    """Work in a process that ends at once before it gives its ``number``-th file its name; how it ended."""
    process = os.fork()
    if process == 0:
        rename, writes = os.replace, []

        def counted(*paths):
            writes.append(paths)
            if len(writes) == number:
                os._exit(9)
            rename(*paths)

        os.replace = counted
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def content(out):
    return sorted(str(path.relative_to(out)) for path in Path(out).rglob("*"))


@pytest.mark.commands
def test_a_run_killed_before_any_write_continues(config):
    whole = runner.run(config).rows
    for number in range(1, 100):
        again = replace(config, out=f"{config.out}-{number}")
        ended = killed_before(number, lambda run=again: runner.run(run))
        if ended == 0:
            break
        assert ended == 9
        assert runner.run(again).rows._table.equals(whole._table)
        assert content(again.out) == content(config.out)
    assert 5 < number < 99
