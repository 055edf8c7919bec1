"""The arena: sealed cases, other people's programs beside ours under one clock, and a time line by commit."""
