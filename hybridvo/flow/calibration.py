"""Numbers of flow and its noise that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""

DIS_NOISE = (0.035, 1.2)
"""Flow noise of DIS (medium) per component: std^2 = first^2 + (second * e)^2, px, e the difference
of the flows in both directions; the first is half as large where DIS goes down to the image's own
pixels. 18 synthetic pairs; ``tests/flow`` measures it again."""
FULL_RESOLUTION_MAX_PIXELS = 160_000
"""Pixels up to which DIS (medium) goes down to an image's own pixels, in three times the time. The
fit inside the true mask errs by 0.014 px instead of 0.073 (``benchmark.py --seed0 900``, heavy)."""
MIN_TEXTURED = 0.002
"""Smallest fraction of the image with texture across its weakest direction. Real and rendered
images have 0.4 to 0.8, at a tenth of their brightness 0.006 to 0.28; a covered lens has none."""
FLOW_CONTRADICTION = (0.8, 2.0)
"""A flow contradicts its images where the median difference after warping is above the first ratio
times that without, while DIS reaches less than 1 / the second of it (less one grey level). 27
pairs: at most 0.25 for the right flow, 0.85 and more for a negated, backward or doubled one."""
CONSISTENT_FLOW_PX = 1.5
CONSISTENT_FLOW_RATIO = 0.05
"""Difference of the flows in both directions, px, and as a fraction of their length, up
to which the flow is valid: the larger of the two counts. By hand."""
MAX_FLOW_STD_PX = 5.0
"""Largest standard deviation of DIS flow that is stated, px. By hand."""
FLOW_TEXTURE_GRADIENT = 2.0
"""Gradient, grey levels a pixel of an image of that size, that counts as texture. It was
chosen by hand as 1.0, above the noise of a dark sensor, and became 2.0 when a later number
took its name; :data:`MIN_TEXTURED` was measured with 1.0."""
TEXTURE_OVER_NOISE = 2.0
"""The same as a multiple of the image's noise: in white noise one pixel in 500 reaches 0.6, in
noise that neighbours share 0.8 to 1.3 (3.4 at 120 rows). In 52 folders of recordings it is 12 to
65, at a tenth of the brightness with noise of 5 grey levels 1.5 to 4.5. By hand, between them."""
SHIFT_GRADIENT = 2.0
"""Gradient, grey levels a pixel, above which a shift of the image is visible. By hand."""

# Photometric refinement
# Where no command is named: chosen by hand; ``make golden`` shows the effect.

UNSTATED_FLOW_STD_PX = 0.5
"""Taken for the standard deviation of an estimated flow that states none, px. True flow has 0."""
