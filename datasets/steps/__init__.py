"""Processing steps: small functions from a clip to what a method needs of it, recorded where they change it."""
