"""Methods of other libraries, for comparison."""
