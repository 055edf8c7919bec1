"""A beamline in software: specimens in the beam, pulses, camera, misalignment, series."""
