"""INSTA: a canonical hash-grid radiance field, warped by the nearest triangle of the tracked mesh."""
