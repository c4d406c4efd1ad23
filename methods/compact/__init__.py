"""Avatars of "ours" in a tenth of the bytes."""
