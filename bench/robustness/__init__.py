"""Trained avatars beyond what was recorded: views, expressions and drivers without ground truth."""
