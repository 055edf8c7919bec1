"""Matter that is generated for simulated scenes: of fluids, solids, soft bodies and meshes, still or changing."""
