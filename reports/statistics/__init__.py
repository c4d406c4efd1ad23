"""Inference from rows: the subject is the unit, pairs share their keys. Numpy, scipy and pandas alone."""
