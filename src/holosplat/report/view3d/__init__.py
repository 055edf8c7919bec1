"""The view in three dimensions: what the page embeds, and the script that shows it."""
