"""The page of a series, and its charts."""
