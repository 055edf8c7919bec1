"""Fitting a trainable Object to a scan: objective, schedule, density control, loop, checkpoints."""
