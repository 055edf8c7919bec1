"""The pages of the benchmark: tables, plots, pictures, text."""
