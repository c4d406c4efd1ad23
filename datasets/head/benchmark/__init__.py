"""Speed and numerical extremes of the head model."""
