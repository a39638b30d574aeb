"""``hybridvo run --export``: the path and the images of a run, as other programs read them."""
