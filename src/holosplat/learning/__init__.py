"""Networks that have seen many scenes: what they guess from few views, and their weights."""
