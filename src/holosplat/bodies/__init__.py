"""Closed bodies of a known rest shape: their shadows, their poses, and the search for these in frames of any times."""
