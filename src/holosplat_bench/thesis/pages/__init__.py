"""The pages of the study, and their pictures."""
