"""What one does with a scan: correct, join, reconstruct, evaluate."""
