"""The conformance kit: does a plug-in keep its contract? For authors of plug-ins and for our own tests.

Each check returns the breaches it found as sentences; none means that the plug-in conforms.
"""

from .methods import check_method
from .metrics import check_metric
from .readers import check_reader

__all__ = ["check_method", "check_metric", "check_reader"]
