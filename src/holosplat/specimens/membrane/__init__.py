"""Elastic membranes: energies, forces, resting meshes, and the test in optical tweezers."""
