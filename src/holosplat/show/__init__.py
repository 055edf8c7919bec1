"""Objects on the screen: a live view in the browser, and layers for napari."""
