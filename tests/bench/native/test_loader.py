"""Compiled kernels are imported once, and where one is missing what is used instead is named."""

import logging
import sys
from types import SimpleNamespace

import pytest

from headbench.bench.errors import UnavailableError
from headbench.bench.native.dispatch import Kernel


def test_an_installed_kernel_is_loaded_with_instruction_sets(monkeypatch):
    module = SimpleNamespace(instruction_sets=lambda: ["avx2", "portable"])
    monkeypatch.setitem(sys.modules, "headbench._there", module)
    kernel = Kernel("headbench._there", "It", "other works")
    assert kernel.load() is kernel.load_or_warn() is module
    assert kernel.instruction_sets == ("avx2", "portable")


def test_a_missing_kernel_is_warned_of_once_and_refused(caplog):
    kernel = Kernel("headbench._not_there", "It", "other works")
    with caplog.at_level(logging.WARNING):
        assert kernel.load_or_warn() is kernel.load_or_warn() is None
    (message,) = (record.message for record in caplog.records)
    assert "_not_there" in message
    assert "C++17 compiler" in message
    assert "other works" in message
    assert kernel.instruction_sets == ()
    with pytest.raises(UnavailableError, match="It is not available.*_not_there"):
        kernel.load()
