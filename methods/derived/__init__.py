"""Avatars derived from a trained one without training: fewer splats, coarser tensors, smaller files, earlier cut-offs."""
