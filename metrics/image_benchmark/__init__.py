"""How fast the image metrics are, next to the usual libraries."""
