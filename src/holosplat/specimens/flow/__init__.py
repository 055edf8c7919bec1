"""Cells in a channel: the flow, the disturbance by the cells, the contacts between cells, and the motion in time."""
