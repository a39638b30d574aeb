"""The factors of a motion, the loops that minimise them, and the covariance."""
