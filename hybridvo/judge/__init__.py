"""How probable an answer is to be right, from all that speaks for it and against it."""
