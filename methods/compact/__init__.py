"""Avatars of "ours" in about a fifteenth of the bytes."""
