"""Files: one module a format. Readers check what they read; writers replace a file whole or not at all."""
