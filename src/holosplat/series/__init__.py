"""Series: many times reconstructed as tasks of their own, on one machine or a cluster, or as their scans appear."""
