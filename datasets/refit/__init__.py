"""Fit the tracking of a capture, made with one head model, by another: FLAME 2023 by FLAME 2020 and the like."""
