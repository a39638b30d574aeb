"""Numbers fitted on data: value, unit, data, and how they are found again.

The probabilities of being right are logistic in what a selector has seen, all without a unit; the
last weight is the offset. ``python tools/calibrate.py`` fits them on the development recordings of
:mod:`hybridvo.synthetic.semi_real` and on the heavy development scenes, with DIS flow.
"""

CUES_RIGHT = (4.4, 0.0)
"""Of the difference of the two best cue scores."""
SELECTOR_RIGHT = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Of :func:`hybridvo.hypotheses.selector.evidence_of`."""
CLEAR_RIGHT = 1.0
"""Share of right answers where the first motion explains nearly all that the depth sensor sees."""

# The numbers below have no unit. They were fitted on the development seeds of the scenarios
# (``tools/benchmark.py``), on rendered walks with DIS flow, and on the real samples.

FEW_TILES = 48
"""With fewer tiles the correlation between errors is hardly known; more of it is then assumed."""
CLUSTERED = 0.6
"""Share of the clustered matrix in the meat, the rest is that of independent errors scaled to the
same mean. Alone the few blocks make weak directions too certain at times (4 of 420 development
pairs of cells beyond 3 sigma, 0 with this share); the other makes all directions equally bad,
though errors of depth leave some of them alone."""
LONG_GROWTH = (1.7, 2.2)
"""Growth of the variance of sums over blocks four tiles wide (kept overlapping) against one tile's,
in units of independent errors, between which the errors come to count as reaching beyond the
blocks. Median and 95 % quantile over development pairs: 1.0 and 1.5 of independent noise,
1.0 to 1.3 and 1.8 to 2.7 of the cells (24 px in tiles of 64 px), 2.2 to 3.1 the median with DIS
flow. So every tenth to twentieth pair of noisy cells is doubted more than it should."""
ABSORBED = 2.0
"""The exponent of the growth is taken so much larger: what errors have in common over the whole
image the fit takes into the motion, so that the residuals show less of it than there is. On
development sequences with DIS flow (240 pairs) the median squared error in units of the covariance,
5.3 expected, was 12 with 1.5, 7 to 9 with 2 and 6 to 8 with 2.5."""
DOUBTFUL_SPREAD, NO_SPREAD = 0.15, 0.35
"""Of the log ratio of two depths: spread from which an answer is degraded, and from which it is
none. Two depths with independent noise of s differ by 0.95 s, so these are 16 and 37 % of noise in
every pixel; real sensors and rendered depth with DIS flow measure 0.001 to 0.018, depth that is
noise from 0.5 to 10 m 0.49 to 0.6, from 2 to 4 m 0.2."""
MIN_TILES = 24
"""Tiles of the whole image in which usable pixels lie, below which a covariance cannot be
trusted: depth errs alike over some 50 px, so that a line across the image holds ten to twenty
independent readings for six unknowns (3 of 59 development lines were beyond 3 sigma, one by 7)."""
EVEN_PARTS = 0.7
"""Dispersion of the parts' scores, as shares of the model's, below which they agree: rendered pairs
have 0.25 in the median, 0.55 at the 90th percentile; with a rolling shutter 1.0 and 2.0."""
UNEVEN_LIGHT = 0.15
"""Share of the weighted squared grey residuals that fields of gain and offset must explain to
be used. Of rendered pairs with even light they explain 0.02 to 0.12, with a vignette of 30 % in the
corners, a lamp or a gamma of 0.6 from 0.26 on."""
WEAK_RATIO = 2e-5
"""Ratio of the information's extreme eigenvalues below which errors that neighbours share, and that
the covariance of one small patch cannot know of, decide a direction: degraded. A frontal plane over
a field of view of 20 degrees has 1e-4, a patch of 20 px at fx = 1120 has 1e-5."""
