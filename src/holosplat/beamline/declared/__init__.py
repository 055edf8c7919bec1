"""Simulated experiments as a TOML file declares them, or as a draw gives them: what is measured, of what, and how."""
