"""Methods and Objects that exist to be compared with: the core and its command line do not know them."""
