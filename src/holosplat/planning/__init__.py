"""The contrast, resolution and data rate of an experiment, before it is done or simulated."""
