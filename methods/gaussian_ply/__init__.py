"""Avatars as splat PLY files: out to common viewers, in from GaussianAvatars."""
