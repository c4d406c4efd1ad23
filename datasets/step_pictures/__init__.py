"""Pictures of what the steps before training make of a capture: jaw bases and expression classes."""
