"""GaussianBlendshapes: splats of a neutral head and linear differences for expressions."""
