"""The command line, and many tasks at once."""
