"""Layouts of other programs of splats and radiance fields: scans from and to them."""
