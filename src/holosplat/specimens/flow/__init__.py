"""Cells in a channel: the flow, what cells do to it and to each other, and how they move in time."""
