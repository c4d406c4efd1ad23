"""The embedded default head: sculpted from an implicit surface, rigged in FLAME's layout."""

from .expressions import SEMANTIC_NAMES as SEMANTIC_NAMES
from .model import procedural_head as procedural_head
from .model import semantic_to_coefficients as semantic_to_coefficients
from .parts import render_parts as render_parts
