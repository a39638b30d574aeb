"""Numbers of the solver that decide: value, unit, data, how to find them again."""

AGREEMENT_RIGHT = 0.25
"""Weight of the log of how far a refined motion agrees with the one that was chosen, beside the
log odds of the choice. Unfitted there: fitted on 458 answers beside a margin alone."""

# Below, without a unit: fitted on the development seeds of the scenarios
# (``tools/benchmark.py methods``), on rendered walks with DIS flow, and on the real samples.

FEW_TILES = 48
"""With fewer tiles the correlation between errors is hardly known; more of it is then assumed."""
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
"""Tiles of the whole image in which usable pixels lie, below which a covariance is not
reliable: depth errs alike over some 50 px (3 of 59 development lines were beyond 3 sigma)."""
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

KERNEL_CUTOFFS = {"cauchy": 2.385, "huber": 1.345, "l2": 1.0}
"""c of the other kernels, standard deviations: 95 % efficient under normal noise (Holland and
Welsch, 1977). The one of ``l2`` has no effect."""
SCALE_PER_RESIDUAL = 1.5
"""First scale of the robust kernel, in medians of the residuals' lengths."""
LARGEST_SCALE_PX = 64.0
"""Largest first scale of the robust kernel, px."""
SEED_STDS = 2.0
"""Largest first scale of the robust kernel from a seed, in standard deviations of where it puts
the pixels, by the covariance that its giver states. Unfitted."""
SEED_SCALE_PX = 1.0
"""The same from a seed without a covariance, px. Of 98 pairs of the kitchen clips 16 are wrong
before the images with it, 20 from about 2 px, 23 from ``SCALE_PER_RESIDUAL`` medians."""
SEED_FRACTION = 0.05
"""Unless fewer of the surest pixels than this fraction fit the seed so well: then it is off by as
much as their residuals show. Unfitted."""
SMALLEST_SCALE_PX = 0.4
"""Last scale of the robust kernel before the noise is estimated, px."""
COARSE_SCALE_RATIO = 0.5
"""Factor from one scale to the next in the coarse fit of a pair."""
BATCH_SCALE_RATIO = 0.7
"""The same in the fit of a batch, which makes one step at each scale instead of up to three."""
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
FINAL_NOISE_PIXELS = 4000
"""Pixels from which the noise of the answer is estimated, about."""
FINAL_NOISE_ROUNDS = 30
"""Most rounds of expectation-maximisation of the answer's noise."""
FLOW_NOISE_FLOOR_PX = 2e-3
"""Smallest noise of the flow, px: float32 coordinates of an image 8000 pixels wide are good to
5e-4 px."""
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
COARSE_STEPS = 3
"""Gauss-Newton steps at each scale of the coarse fit."""
REESTIMATE_ROUNDS = 2
"""How often noise and motion are estimated in turn."""
REESTIMATE_NOISE_ROUNDS = 5
"""Rounds of expectation-maximisation each time."""
REESTIMATE_STEPS = 4
"""Gauss-Newton steps each time, and once more when the noise of the answer is known."""
SCALE_TOLERANCE = 0.1
"""Length of the last step at a scale of the robust kernel, as a fraction of that scale."""
NOISE_TOLERANCE = 1e-3
"""Length of the last step with known noise, in standard deviations of the flow."""
NOISE_CHANGE = 1e-3
"""Relative change of both variances below which the rounds of their estimate end."""
MIN_NOISE_PIXELS = 8
"""Smallest number of pixels from which a noise is estimated."""
FIRST_INLIER_RATIO = 0.7
SMALLEST_INLIER_RATIO = 0.01
LARGEST_INLIER_RATIO = 0.999
"""Fraction of the pixels that follow the motion, before the first round of the noise's
estimate, and its limits."""
START_FLOW_NOISE_PX = 0.5
"""Noise of the flow from which its estimate starts, px."""
START_DEPTH_NOISE = 0.01
"""Noise of log depth from which its estimate starts."""
TYPICAL_QUANTILE = 0.2
"""Quantile of the variances of an image that is their unit, the typical variance."""
MAX_DEPTH_SHIFT = 0.3
"""Largest correction of a log depth: the linearization in log depth holds no farther."""
BATCH_STEPS = 20
"""Most Newton steps on all pixels of a batch."""
BATCH_FIT_STEPS = 6
"""Gauss-Newton steps of a fit to the pixels that a network is sure of."""
BATCH_NOISE_STEPS = (2, 3, 3, 0)
"""Gauss-Newton steps after each estimate of the noise of a batch."""
RIVAL_WEIGHT = 0.25
"""Robust weight from which a pixel follows a motion, where its rivals are counted."""
RIVAL_SCALES = 3.0
"""Width of the robust kernel with which they are counted, in last scales."""
FOLLOWING_WEIGHT = 0.3
"""Robust weight from which a pixel follows a motion, where both depths are compared."""
MIN_USABLE_RATIO = 0.05
"""Fraction of a grid's pixels that must be usable; with fewer the grid is made finer."""
MIN_INLIER_RATIO = 0.02
"""Fraction of the pixels that must follow a motion; with fewer the estimate fails."""
MIN_ROBUST_SUM = 6
"""Sum of the robust weights, in pixels, below which six unknowns are not determined."""
MIN_COMPARED_DEPTHS = 100
"""Points with a depth in both frames, below which the depth maps are not compared."""
MIN_DEPTH_NOISE_POINTS = 50
"""Such points, below which the noise of depth is not estimated from them."""
MIN_TILE_PX = 8
MAX_TILE_PX = 64
"""Smallest and largest side of a tile of the covariance, px."""
STEP_TOLERANCE_STD = 30.0
"""Length of the Newton step from the coarse grid's solution to that of all pixels of a pair,
standard deviations: of 114 real pairs none was longer. Convergence is quadratic: what such a step
leaves is a tenth of a standard deviation."""
BATCH_STEP_TOLERANCE_STD = 4.0
"""The same of a batch."""
ROUNDED_STEP_STD = 0.05
"""Mean motion of the image, standard deviations, below which a step may be rounding: of a batch,
where it is not half as long as the shortest before it; of a pair, its only one."""
MAX_STEP_RATIO = 4.0
"""A step of a batch is taken if delta^T H delta is at most so many times its predicted
decrease: 1 / ``MIN_DECREASE``."""
MAX_EXACT_STEP_RATIO = 100.0
"""The same near a solution that the gradient needs exactly: there the full derivative may be
much flatter than H, and is right."""
EXACT_PERIOD = 3
"""Steps of a batch between two exact derivatives."""
FIRST_BATCH_STEPS = 3
"""First steps of a batch with exact derivatives, none of which ends it as rounding."""
BEHIND_DISTANCE2 = 1e8
"""Squared distance, in standard deviations, that a pixel behind the camera is charged: under the
kernel of Geman-McClure, in single precision, as much as any outlier can cost."""
MIN_CURVATURE_RATIO = 0.2
"""Smallest eigenvalue of the full second derivative, as a fraction of that of Gauss-Newton's
matrix, with which the curvature of the robust weights is believed: with few inliers it is noise."""
SMALLEST_LEFT_OVER = 0.25
"""Smallest fraction of the scores' variance that the fit is taken to leave in blocks of tiles."""

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
MIN_ROUND_STD = 0.3
"""Standard deviations by which a round of the photometric refinement moves the motion at least, or
it was the last one: the round after it moves by a tenth to a quarter of that (median of five
recordings)."""
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
GREY_NOISE_FLOOR = 0.1
"""Smallest standard deviation of the photometric residual, grey levels: rounding to 8 bits leaves
0.08 after the blur."""
IMAGE_TOLERANCE = 0.1
"""Length of the last step on images and depth maps, in standard deviations."""
COMPARED_PARTS = ((2, 2), (4, 1))
"""Rows and columns of the parts into which an image is cut to see whether they agree
(:data:`EVEN_PARTS`): a lens errs by quadrant, a rolling shutter by row."""
ROBUST_CURVATURE = 0.6
"""Second derivative of the Geman-McClure cost at its minimum over the sum of its weights: 0.73 for
normal residuals, less with outliers. A Newton step divides by it."""
MIN_PATCH_AREA = 1e-3
"""Area in the current image, px, of a pixel of the previous one, below which its surface is viewed
edge-on and its gradient is not carried over."""
PLANE_REACH_PX = 3
"""Distance to the four neighbours that span the plane at a pixel of a depth map, px: the steps of a
structured-light sensor are wider than one pixel."""
PLANE_EDGE = 0.1
"""Relative difference of depth to such a neighbour beyond which the pixel lies at an edge and has
no plane."""
PLANE_NOISE_FLOOR = 1e-4
"""Smallest standard deviation of a distance to a plane, as a fraction of the depth."""
MIN_DEPTH_EIGENVALUE = 1e-3
"""Ratio to the largest eigenvalue of the (scaled) information of the depth maps, below
which they do not determine a direction of the motion."""

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
LIGHT_SIDE = 3
REGION_SIDE = 5
"""Sides of the squares, in points of the grid, over which the change of light is averaged and over
which a region is called explained or not."""
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
measured any more. Unfitted: an absurd motion hides everything behind what stands before it."""
MIN_BELIEVED = 0.5
"""Weight by a belief from which a pixel takes part in the refinement. Unfitted."""

# Poses of patches, and the region of a seed
#
# Chosen on the box clips and a few kitchen clips, with the prototype that
# ``tools/benchmark.py pwvo_parts`` measures today.

PATCHES = 48
"""About how many patches an image has. With 192 and with 12 the fused pose is as good on some clips
and worse on others."""
PATCH_PIXELS = 20_000
"""About how many pixels of an image its patches have. Unfitted."""
PATCH_SCALES = (4.0, 2.0, 1.0, 1.0)
"""Width of the robust kernel in each pass over the patches, in flow noises of the hypothesis. From
3 px beside it, the fused pose comes back on all heavy pairs and 20 of 21 kitchen ones."""
PATCH_PRIOR_RAD = 0.05
"""Standard deviation of a patch's pose where its pixels leave it open, as an angle. Unfitted."""
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
"""Standard deviation of a difference of depths of one surface: of the depth. Unfitted, so are the
next three."""
DEPTH_NOISE_PER_M = 0.002
"""The same, of its square, 1 / m: what structured light adds."""
DEPTH_NOISE_SIGMAS = 1.4
"""The same in standard deviations of one depth: two depths differ."""
HIDDEN_SIGMAS = 3.0
"""Standard deviations by which what is measured must be nearer to hide a point."""
