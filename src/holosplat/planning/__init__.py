"""What an experiment would see, before it is done or simulated."""
