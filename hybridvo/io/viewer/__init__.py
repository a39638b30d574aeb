"""Rerun: what a tracker sees and how sure it is, in a viewer or in a file."""
