"""Synthetic captures: a procedural person, performed, photographed by a path tracer, written as a capture."""
