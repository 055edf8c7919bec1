"""Truth objects: meshes made closed, red blood cells by their published shape, capsules, foam, and balls in series."""
