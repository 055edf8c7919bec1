"""The study of the thesis that began this project: runs, findings, pages."""
