"""The protocol linter: faults of a capture that let a comparison run and make its numbers wrong."""
