"""From matter to frames: the only way that leads there."""
