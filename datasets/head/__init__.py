"""The animatable head model: arrays in FLAME's layout, the differentiable model, loaders and teeth."""
