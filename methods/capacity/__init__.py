"""How large an avatar of "ours" has to be, decided from its training data."""
