"""COLMAP sparse models: a clip's cameras written by pycolmap, and the cameras of a model read with care."""
