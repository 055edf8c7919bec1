"""Truth objects: meshes made closed, and red blood cells by their published shape."""
