"""``hybridvo doctor``: what is measured of a recording or a camera, and the answers from it."""
