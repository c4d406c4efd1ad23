"""NeRSemble recordings: read raw, written for tests, prepared as captures in the GaussianAvatars layout."""
