"""The benchmark suite: cases × methods × seeds, under one physics and one set of scores."""
