"""Numbers of the solver that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""


# Below, without a unit: fitted on the development seeds of the scenarios
# (``tools/benchmark.py methods``), on rendered walks with DIS flow, and on the real samples.

CLUSTERED = 0.6
"""Fraction of the clustered matrix in the meat, the rest is that of independent errors scaled to
the same mean. Alone the few blocks make weak directions too certain at times (4 of 420 pairs)."""
LONG_GROWTH = (4.0, 5.0)
"""Growth of the variance of sums over blocks four tiles wide against one tile's, in units of
independent errors, between which residuals come to count as those of a compromise between several
motions, whose errors reach over the whole view. On the development sets of :data:`SHARED_BLOCK`
answers that err by less than 0.3 px have at most 4.3, 97 % of those outside static scenes 3.4; 9 of
the 12 answers of ``classical`` that err by more have 4.3 to 7.7."""
ABSORBED = 2.0
"""The exponent of the growth is taken so much larger: what errors have in common over the image the
fit takes into the motion. Median squared error in units of the covariance, 5.3 expected, on 240
pairs with DIS flow, when all growth counted: 12 with 1.5, 7 to 9 with 2, 6 to 8 with 2.5."""
SHARED_BLOCK = 4
"""Side of the blocks whose errors are compared, px of the grid (16 px at a width of 512). What
neighbouring blocks share, parts of the view are taken to share: NEES of ``hybrid-flow`` on static,
light and heavy scenes and bare walls 4.2, 4.9, 6.1 and 6.1 in the median, 5.3 expected, 9 of 160
beyond 3 sigma; with 8, whose fraction is a third, 7.8, 8.8, 11 and 8.6, and 23
(``tools/benchmark.py sigmas --methods hybrid-flow --sets "static, development;light,
development;heavy, development;bare walls, development"``)."""
COHERENT_STDS = 3.0
"""Standard errors, of independent errors, by which the correlation of neighbouring flow errors must
exceed 0 to be believed: of 36 pairs of the scenarios with independent noise one has more, by
0.0005; DIS flow has 0.06 to 0.37, where chance gives 0.01 (the same command)."""
DOUBTFUL_SPREAD = 0.15
NO_SPREAD = 0.35
"""Of the log ratio of two depths: standard deviation from which an answer is degraded, and from
which it is none. Real sensors and rendered depth with DIS flow measure 0.001 to 0.018, noise 0.49
to 0.6."""
MIN_TILES = 24
"""Tiles of the whole image in which usable pixels lie, below which a covariance is not reliable:
depth errs alike over some 50 px. Of 68 pairs of a Kinect, a D435 and a HoloLens with depth on a
strip of 20 px or a patch of 48 px alone, 28 are ``ok`` without this number and ``WEAK_RATIO``, 16
of these wrong; with both none is ``ok``."""
SHARED_SHIFT = 0.12
"""Displacement that whole parts of an image share, as a fraction of the residual's noise in pixels:
from interpolation, light, blur. NEES of right answers as a multiple of what is expected, with 0,
0.1, 0.12 and 0.15 for this and the next: corridor 1.1, 0.4, 0.45, 0.35; books 1.4, 0.7, 0.75, 0.6
(``tools/benchmark.py sigmas --pairs 16 --sets "tripod, corridor;tripod, books"``)."""
SHARED_DEPTH_ERROR = 0.12
"""The same of the distances between two depth maps, as a fraction of their noise."""
MIN_EQUAL_DEPTHS = 0.05
"""Fraction of pixels whose right neighbour has the same depth, above which a sensor rounds: 0.15 to
0.75 on recordings, 0.0 where depth is rendered in single precision. By hand."""
QUANTUM_PERCENTILE = 20.0
"""Percentile of the differences of neighbouring depths that is the step of the sensor: it gives
0.0027 to 0.0029 / m on Kinects, whose step is 0.00285 / m."""
EVEN_PARTS = 0.7
"""Dispersion of the parts' scores, as fractions of the model's, below which they agree: rendered
pairs have 0.25 in the median, 0.55 at the 90th percentile; with a rolling shutter 1.0 and 2.0."""
WEAK_RATIO = 2e-5
"""Ratio of the information's extreme eigenvalues below which a direction is degraded: a frontal
plane over 20 degrees has 1e-4, a patch of 20 px at fx = 1120 has 1e-5."""

# Refinement on flow and depth
#
# Where no command is named: chosen by hand; ``make golden`` shows what a change does.

SEED_STDS = 2.0
"""Largest first scale of the robust kernel from a seed, in standard deviations of where it puts
the pixels, by the covariance that its giver states."""
SEED_SCALE_PX = 1.0
"""The same from a seed without a covariance, px. Of 98 pairs of the kitchen clips 16 are wrong
before the images with it, 20 from about 2 px, 23 from ``SCALE_PER_RESIDUAL`` medians."""
SEED_FRACTION = 0.05
"""Unless fewer of the surest pixels than this fraction fit the seed so well: then it is off by as
much as their residuals show."""
FLOW_NOISE_CAP_PX = 1.2
"""Largest noise of the flow that a single motion may have during a search, px."""
DEPTH_NOISE_CAP = 0.08
"""Largest noise of log depth that a single motion may have: sensors and learned depth have less."""
USUAL_DEPTH_NOISE = 0.01
"""Largest noise of log depth taken where the parallax is too small to show it: a usual sensor's."""
OBSERVABLE_DEPTH_NOISE_STD = 2.0
"""Standard errors by which the variance of log depth must exceed 0 to be believed."""
NOISE_CAP_FACTOR = 2.5
"""Factor on the noise found in the search by which that of the answer may be larger."""
DEPTHS_PER_PAIR = 1.32
"""Noise of the log ratio of two depth maps, as a multiple of that of one: sqrt(2), less what
the interpolation of the current map averages away. ``tests/solver/test_covariance.py`` holds
the result to 20 % of the true noise."""
MIN_DEPTH_NOISE_CAP = 0.02
"""Smallest cap on the noise of log depth of the answer."""
OUTLIER_RADIUS_PX = 4.0
"""Smallest radius of the disc over which outliers are evenly distributed, px."""
OUTLIER_RADIUS_STD = 8.0
"""The same radius in standard deviations of the flow."""
COHERENCE_CUTOFF = 4.0
"""Length of a whitened residual, standard deviations, beyond which it is left out of the blocks."""
SURFACE = 0.05
"""Largest relative difference between four neighbours of a depth map that are one surface."""
RIVAL_WEIGHT = 0.25
"""Robust weight from which a pixel follows a motion, where its rivals are counted."""
RIVAL_SCALES = 3.0
"""Width of the robust kernel with which they are counted, in last scales."""
FOLLOWING_WEIGHT = 0.3
"""Robust weight from which a pixel follows a motion, where both depths are compared."""
MIN_INLIER_RATIO = 0.02
"""Fraction of the pixels that must follow a motion; with fewer the estimate fails."""
MIN_ROBUST_SUM = 6
"""Sum of the robust weights, in pixels, below which six unknowns are not determined."""
MIN_COMPARED_DEPTHS = 100
"""Points with a depth in both frames, below which the depth maps are not compared."""
MIN_DEPTH_NOISE_POINTS = 50
"""Such points, below which the noise of depth is not estimated from them."""

# Photometric refinement
# Where no command is named: chosen by hand; ``make golden`` shows the effect.

MIN_STATIC_WEIGHT = 0.25
"""Robust weight of a pixel in the refinement on flow, from 0 to 1, below which its
grey value is not used."""
MIN_TEXTURED_PIXELS = 200
"""Pixels with texture, depth and that weight, below which the images of a pair are not used."""
MIN_PLANE_POINTS = 300
"""Points of the previous depth map that must be visible on a surface of the current one, below
which the depth maps of a pair are not used."""
FLOW_PRIOR_INFLATION = 32.0
"""Factor on the covariance of the motion by flow where it becomes the prior of the images: DIS flow
errs alike far beyond the tiles of the covariance."""
IMAGE_INFLATION = 4.0
"""Factor on the covariance by images and by depth maps: their errors are alike far beyond the
tiles as well."""
PRIOR_FREEDOM = 6.0
"""Degrees of freedom of the Student kernel of a prior motion, whose covariance is an estimate."""
MIN_IMAGE_CORRELATION = 0.5
"""Weighted correlation of the two images along a motion, below which they do not match."""
MIN_IN_VIEW = 0.3
"""Fraction of the weight that must fall inside the current image."""
MIN_ADDED_INFORMATION = 0.1
"""Information that the images add in their best direction, as a ratio to that of the flow, below
which the motion by flow is kept."""
MIN_IMAGE_GAIN = 0.2
MAX_IMAGE_GAIN = 5.0
"""Smallest and largest gain of the current image over the previous one: exposure
changes by less."""
PLANE_REACH_PX = 3
"""Distance to the four neighbours that span the plane at a pixel of a depth map, px: the steps of a
structured-light sensor are wider than one pixel."""
PLANE_EDGE = 0.1
"""Relative difference of depth to such a neighbour beyond which the pixel lies at an edge and has
no plane."""

# The motion by images and depth maps alone, without flow.

DIRECT_PRIOR_STD = (0.3, 0.15)
"""Standard deviations of the translation, m, and of the rotation, rad, of the motion without the
images: so wide that it does not decide."""
NOISE_SHIFT_PX = 0.25
NOISE_GREY = 0.5
"""A point follows a motion where its residual is explained by a shift of the image, px,
and by noise, grey levels (standard deviations)."""
MIN_FOLLOWING = 0.5
"""Product of the two robust factors of a point, by grey value and by depth, above which it follows
the motion."""
FLAT_GRADIENT = 2.0
"""Gradient, grey levels a pixel, whose texture counts half: a smooth surface looks the same
wherever it went."""
REGION_CUTOFF = 7.0
"""Width of the robust kernel of a region's shift, standard deviations of the difference: wide,
since a shift that is sought is no outlier. By hand, as are the next three; the probability that
rests on them is fitted with them (``DIRECT_EXACT`` of the judge)."""
MAX_REGION_SHIFT_PX = 0.7
"""Standard deviation of a region's shift before the images are compared, px: more is no shift that
the gradient shows."""
SHOWN_SHIFT = 50.0
"""Information of a region, in units of that before, with which its texture counts half."""
MIN_SEEN_OF_REGION = 0.4
"""Fraction of a region's points that must be seen, by their weight."""
MAX_HIDDEN = 0.5
"""Fraction of what is believed static that something nearer may hide, or of which no depth is
measured any more. An absurd motion hides everything behind what stands before it."""
MIN_BELIEVED = 0.5
"""Weight by a belief from which a pixel takes part in the refinement."""

# Poses of patches, and the region of a seed
#
# Chosen on the box clips and a few kitchen clips, with the prototype that
# ``tools/benchmark.py pwvo_parts`` measures today.

PATCH_PRIOR_RAD = 0.05
"""Standard deviation of a patch's pose where its pixels leave it open, as an angle."""
AGREEMENT_CUTOFF = 2.0
"""Distance of a patch from the fused pose, in typical ones, at which it counts a quarter."""
LARGEST_SEED_DISTANCE2 = 10.0
"""Largest squared distance from its seed, per direction, that a motion may have while the robust
kernel narrows: stated covariances are too small by 3 in the median, and by up to 50."""
LARGEST_SOLUTION_DISTANCE2 = 3.0
"""The same of the solution: beyond it the seed is kept. Without it 4 of 42 box pairs are wrong
whose seeds are right."""

# Where a point lies before or behind what another frame measures

DEPTH_NOISE_M = 0.003
"""Standard deviation of a difference of depths of one surface: of the depth."""
DEPTH_NOISE_PER_M = 0.002
"""The same, of its square, 1 / m: what structured light adds."""
DEPTH_NOISE_SIGMAS = 1.4
"""The same in standard deviations of one depth: two depths differ."""
HIDDEN_SIGMAS = 3.0
"""Standard deviations by which what is measured must be nearer to hide a point."""
