"""The regression gate: results held against a committed baseline."""
