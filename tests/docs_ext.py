"""The documentation's own modules, which are no part of the package."""

import sys
from importlib import import_module
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "docs" / "_ext"))
stored_results = import_module("stored_results")
