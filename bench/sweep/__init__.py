"""A sweep: what can be derived from the avatars of a finished run, measured like the run itself."""
