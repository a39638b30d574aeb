"""Numbers fitted on data: value, unit, data, and how they are found again.

The probabilities of being right are logistic in their evidence (for PWVO the margin between the
best score and that of another motion): weights, and one that stands alone. ``python
tools/calibrate.py`` fits them on the makers of ``tools/makers.py`` that are for calibration, each
with the same weight: clips and tripod recordings of others, the development recordings of
``hybridvo.lab.synthetic.semi_real``, heavy scenes and an escalator, and scenes without an
answer.
Where "the same pairs" are named, they are 1000 of the development recordings, the heavy scenes of
seeds 900 to 905 with DIS flow, and 100 scenes without an answer.
"""

from typing import NamedTuple

CUES_RIGHT = (0.97, 2.80, 2.12, 4.49, 2.28)
"""Of the evidence of the cues (see :func:`hybridvo.hypotheses.select.cue_evidence`). 396 of 475
right on 260 semi-real pairs, the heavy ones, static recordings, scenarios and 15 pairs of unrelated
images (``tools/calibrate.py --pairs 260``): AUROC .86, calibration error .03. By the margin alone,
with a large one where there is no other motion, it was .62 and .11, and all unrelated images were
believed."""
NO_MOTION = -2.0
"""PWVO's score of no motion being the camera's. In training it was 0, with which two equal
motions would be believed; on 1500 development pairs AUROC .870 with 0, .873 with -1 and -2, .866
with -3 (``tools/calibrate.py`` after a change)."""
CHOICE_RIGHT = (0.318, 0.418, -0.638, 0.126, -0.374)
"""Of a motion chosen among all that were found in the flows of a pair, in the evidence of
:class:`hybridvo.judge.choice.ChoiceEvidence`: 738 of 766 right, after one, two and three flows, on
seven makers; those in which something moves in a real view count ten times as much as the others,
which hardly ever fail. AUROC of the answers to 220 pairs of kitchen, box and semi-real, each maker
judged by a fit on the others: .87 (the margin alone: .76). Where the pixels lie (spread, border)
gave .88, but let it doubt one static pair in eight (``tools/calibrate.py``)."""
LEAST_SHARE = 0.01
"""Fraction of the view that is added to a share before its logarithm is evidence. By hand."""
SCORE_RIGHT = (0.71, -0.16)
"""Of the margin of PWVO's best score, where the network answers alone: 352 of 384 right, AUROC
.96, calibration error .01, before its choices had evidence of their own. Not fitted again."""
PWVO_RIGHT = (0.57, 0.25, 0.49, -1.72)
"""Of PWVO's, refined: lead, log agreement, log odds; 428 of 458 right, AUROC .97, error .01."""
DIRECT_RIGHT = (-11.33, -1.56, 0.05)
"""Of a motion found without flow, in its standard deviation, px, and the log of the fraction of the
texture in unexplained regions: 1480 of 3142 right, AUROC .90, calibration error .04."""
CUE_WEIGHTS = {
    "inlier_ratio": 0.35,
    "border_coverage": 0.65,
    "depth_extent": 1.29,
    "mean_log_depth": 2.11,
    "flow_noise": -1.38,
    "prior": 1.0,
}
"""Weights of the cues of :mod:`hybridvo.hypotheses.cues`, a multinomial logit of which motion
is the camera's, on such pairs (before they came in two sizes), the heavy scenes with true flow
and the scenarios, seeds 500 to 511 (``--cues --pairs 100``). The prior's is by hand: nats."""
MIN_PROBABILITY = 0.9
"""Probability of being right below which a motion is degraded: of 220 pairs of kitchen, box and
semi-real, each maker judged by a fit on the others, 7 of 22 wrong ones lie above it, 28 of 198
right ones below. With 0.86 these are 9 and 16, with 0.92 4 and 36 (``tools/calibrate.py``)."""
DIRECT_PROBABILITY = 0.95
"""That from which no flow is computed: 3 of 353 such motions on the same pairs are wrong.
Below, flow's answer is taken."""
INLIER_REMOVAL_CUTOFF = 0.8
"""Factor on the kernel's cutoff within which pixels are set aside with a motion: at 2 the right one
is found in 80 % of the same pairs, from 0.5 to 1 in 84 %."""
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
DIS_PATCH_STRIDE = 4
"""Distance of the patches of DIS (medium), px: as many answers are right as with 3, in three
quarters of the time. By hand."""
TEXTURE_SIDE_PX = 120
"""Shorter side to which images are shrunk to measure their texture, px: that averages the
noise of a sensor out. By hand; ``make golden`` shows the effect of a change."""
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
COMPARED_SIDE_PX = 100
"""Shorter side to which a pair is shrunk to compare it with its flow, px: details do not
matter there. By hand."""
MIN_COMPARED_PIXELS = 200
"""Such pixels of a pair of that size, below which a flow is not compared with its images.
By hand."""

MIN_LEAD = 0.0025
"""Mean flow, fraction of the width, by which images or depth maps must lead away from a motion at
least before they contradict it: 1.6 px of 640."""
IMAGE_LEAD = 0.04
"""The same as a fraction of the motion's own flow. DIS flow of the recordings in
``tools/golden.py`` is at 0.03 in the median and 0.08 at most, flow of half its size at 1."""
IMAGE_LEAD_GAIN = 1.25
"""How much smaller the residual of the images must be where they lead: DIS flow of static
recordings 1.0 to 1.3, flow of half its size 1.5 to 12 (36 pairs each)."""
DEPTH_LEAD = 1.0
"""Mean flow to which the depth maps lead, as a fraction of the motion's own: up to 0.6 of a turning
Kinect, whose depth is taken at another time than its image; 1 and more where the image is that of
another time altogether."""
CLEAR_DEPTH_LEAD = 0.15
"""The same where the depth maps fit each other much better there."""
DEPTH_LEAD_GAIN = 5.0
"""How much smaller their distance must be there: up to 2.9 times of a turning Kinect, 70 and more
of rendered scenes whose images are mirrored, while their depth maps are not."""
DEPTH_LEAD_STD = 5.0
"""Standard deviations that this must be: of right motions of rendered pairs 3.4 at most, of frozen
images 6 and more, with the noise of structured light."""
CONTRADICTED_RIGHT = 0.1
"""Probability of a motion that images or depth maps contradict: none of 57 was right."""
PLAUSIBLE_DEPTH_M = (0.1, 200.0)
"""Medians of a depth map in metres, without the sky; outside of them it has another
unit. By hand."""
EVERYDAY_DEPTH_M = (0.3, 8.0)
"""Where the median of an indoor depth map usually lies, m: of several units the one that
leads there is named. By hand."""
SKY_DEPTH_M = 1000.0
"""Depth beyond which a pixel shows the sky, m: renderers state such depths, no sensor
reaches them."""
MIN_NEARER_THAN_SKY = 0.1
"""Ratio of nearer pixels to those beyond, below which the depths are not in metres. By hand."""
MAX_BEHIND_CAMERA = 0.1
"""Fraction of the points of a frame that may end behind the camera before its mean flow under a
motion counts as infinite. By hand."""
MIN_DEPTH_SHARE = 0.002
"""Fraction of a frame's pixels with valid depth below which no motion starts from it: sparse laser
depth covers 0.04 and more, a covered depth camera leaves single pixels."""
NO_MOTION_PROBABILITY = 0.05
"""Probability of being right below which a motion is not applied to the path."""
KEYFRAME_FLOW = 0.05
"""Largest mean ego flow from a keyframe, as a fraction of the image's width; DIS follows a
tenth."""
KEYFRAME_AGE = 12
"""Frames that a keyframe is used for at most: so many are kept."""
KEYFRAME_CORRELATION = 0.5
"""Correlation of the errors of two motions from one keyframe, whose noise they share."""
SAME_MOTION = 16.8
"""Squared distance of two estimates of a motion, in standard deviations of both, up to which they
are of one: 99 % of a chi-square of six numbers."""
PLACES = 10
"""Earlier frames that are kept to find a lost path again. By hand."""
PLACE_DISTANCE = 0.2
"""Mean ego flow between two places at least, as a fraction of the image's width: ten cover about
two views, and matches bridge more than that (``tools/benchmark_wide_steps.py``). By hand."""
MIN_LIKENESS = 0.5
"""Correlation of small images from which a place is tried: it costs a motion, and the motion must
be ok to count. By hand."""
ALIKE_PLACES = 3
"""Places that are tried, those that look most alike first: where a scene repeats itself each fits,
and none is believed. By hand: each costs a motion."""
CHANGE_DECAY = 0.9
"""Factor on the weight of earlier changes of the motion with every new one. By hand, as the
next four; ``make golden`` shows the effect of a change."""
MIN_CHANGES = 3
"""Changes of the motion; with fewer their standard deviation is not known yet."""
CHANGE_INFLATION = 2.0
"""Factor on the mean square of the changes in the prior: a larger one may come."""
MIN_CHANGE_STD = 1e-3
"""Smallest standard deviation of a change, m and rad: no camera repeats its motion exactly."""
IDENTITY_STD = (1.0, 0.3)
"""Standard deviations of the translation, m, and of the rotation, rad, of a step of a
hand-held camera of which nothing is known: at most so large."""
WRONG_PX = 1.0
"""Mean error of the ego flow, px at native size, beyond which a motion is called wrong where the
ground truth is exact (rendered): 1 px is what a user of a map sees. The limit grows with its
error."""
RATE_CONFIDENCE = 0.95
"""Probability that the stated interval of a rate covers it. A convention."""
DEPTH_SPREAD_QUANTILES = (0.1, 0.9)
"""Quantiles of a depth map whose ratio is stated in reports. By hand."""
TRUTH_NOISE = {
    "tum": (0.4, 0.004),
    "7scenes": (0.15, 0.005),
    "folder": (0.15, 0.005),
    "kitti": (0.1, 0.04),
}
"""What the ground truth between two frames errs by, degrees and metres, by the reader's kind:
motion capture, the paths of a SLAM system (also taken for one's own recording), GPS with an
inertial unit. Chosen so that a right motion stays below the limit in 19 of 20 pairs; 95th
percentile of ``epe_l2_px`` in ``steps.csv`` of ``hybridvo run DIR`` (status ok), and the limit
there, px: fr1_xyz 3.2 (4.1), fr1_rpy 5.2 (4.2), rooms_110 1.3 (1.6), kitti02 and kitti06 at half
size 0.9 and 1.2 (1). ``7scenes`` was not measured: its ground truth is of a SLAM system too."""
MAX_COORDINATE_M = 1e12
"""Largest coordinate of a position that is evaluated, m: a double resolves 0.1 mm there, beyond it
errors of millimetres are rounding, and squares of 1e160 overflow."""
MIN_VALID_DEPTH = 0.1
"""Fraction of the pixels with depth, in the median frame, from which ``doctor`` is content.
Recordings that give right motions have 0.17 (lidar) to 1; with a tenth of the pixels motions are
degraded."""
EMPTY_DEPTH = 0.01
"""Fraction below which a frame is one without depth."""
MIN_TEXTURE = 0.03
"""Fraction of the pixels with a gradient above 2 grey levels. Recordings have 0.17 to 0.9."""
MIN_FOCUS = 0.4
"""Second over first derivative at strong edges: 0.9 to 1.9 on 16 recordings and rendered scenes,
0.16 to 0.27 with a Gaussian blur of three pixels over them."""
CLOCK_SHIFT_PX = 2.0
"""Pixels by which depth lies beside the image, because the camera turns between the two, from which
this is named as a likely cause. Unfitted."""
CENTRAL_PRINCIPAL_POINT = (0.35, 0.65)
"""Place of the principal point, as a fraction of the width and of the height, outside of which
``doctor`` and ``run`` suspect intrinsics of another resolution. Unfitted: those of 43
recordings lie at 0.47 to 0.54, of twice the resolution at 1 (``hybridvo doctor``)."""
NORMAL_REGISTRATION_SHIFT = 0.02
"""Displacement of the edges of depth beside those of the image, as a fraction of the longer side,
from which ``doctor`` reports it. 11 recordings and rendered scenes have 0 to 0.012 (8 px of 640:
fr1_xyz), and moved by 60 px they have that and 60 px; stereo and lidar depth have no clear best
one."""
CERTAIN_REGISTRATION_STDS = 6.0
"""Standard deviations of the agreement of edges over all displacements, above which the best one is
believed. On the same recordings."""
CERTAIN_ZOOM_STDS = 7.5
"""The same for depth that is enlarged or reduced, of the best of 13 factors. Depth that is not
registered has 15, at the factor that its calibration states (``tripod/unregistered``); 9 registered
recordings have 5 to 12.6, at a factor of 1 wherever it is above 6. ``hybridvo doctor DIR``."""
NEEDED_REGISTRATION_GAIN = 1.5
"""How many times as good the best displacement must be as the best one within
``NORMAL_REGISTRATION_SHIFT``. On the same recordings."""
MIN_SHIFT_PX = 2.0
"""Displacement, px, below which small images are not reported as out of register. By hand."""
STAMP_GAP_FACTOR = 1.5
"""Factor on the median interval of time stamps above which one is a gap. Chosen by hand."""
MAX_LATE_SHARE = 0.1
"""Fraction of gaps among the intervals above which ``doctor`` states that frames were dropped."""
MAX_JITTER = 0.2
"""Standard deviation of the intervals about a whole number of frames, frames. A Kinect has 0.13
(fr1_rpy: ``hybridvo doctor DIR``); uniform ones, by which no frame can be counted, 0.29."""
DOCTOR_SECONDS = 5.0
"""Seconds that ``doctor`` looks at a live camera: 150 frames, two turns to and fro. By hand."""
MIN_RATE_RATIO = 0.9
"""Ratio of the rate of a live camera to the one requested, from which it holds. By hand."""
MIN_CLOCK_PAIRS = 15
"""Pairs in a row from which clocks of colour and depth are compared. By hand: half a second."""
MIN_CLOCK_MOTION_PX = 0.5
"""Standard deviation of the image's motion, px of 320 a frame, from which they are. By hand."""
CLOCK_SMOOTHING = 1.5
"""Standard deviation of the smoothing of both motions, frames. Stamps that jitter shake both alike:
without it the offsets of fr1_rpy, paired some frames late, err by up to 26 ms, with it by 1 ms."""
MIN_CLOCK_CORRELATION = 0.9
"""Correlation of the motions of colour and depth from which their offset is believed: fr1_rpy has
0.99 at any offset of its stamps, rooms_110 (3 frames a second) 0.96. ``hybridvo doctor DIR``."""
MAX_CLOCK_STD_S = 0.02
"""Standard deviation of the offset, s, above which it is not known. fr1_rpy has 0.004 in 100
frames at 30 Hz, rooms_110 0.09 at 3 Hz. ``hybridvo doctor DIR``."""
MAX_CLOCK_OFFSET_S = 0.025
"""Offset of the clocks, s, from which ``doctor`` reports it: in a turn of 45 degrees a second depth
lies 10 px of 640 beside its image. A Kinect has 0.019 (fr1_rpy); with its stamps of depth moved by
0.05 and -0.07 s it has 0.070 and -0.052. ``hybridvo doctor DIR``."""
CLOCK_SIGMAS = 3.0
"""Standard deviations by which the offset must differ from 0."""

# Below, without a unit: fitted on the development seeds of the scenarios (``tools/benchmark.py``),
# on rendered walks with DIS flow, and on the real samples.

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
(``tools/benchmark_sigmas.py --methods hybrid-flow --sets "static, development;light,
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
(``tools/benchmark_sigmas.py --pairs 16 --sets "tripod, corridor;tripod, books"``)."""
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

# Of the baselines whose largest residual of an inlier follows the flow's noise.

INLIER_STDS = 3.0
"""Largest residual of an inlier, in standard deviations that the flow states (median over the
sampled pixels): of a residual in two directions 99 % are below. Of 1, 2, 3, 4, 6 and 8 on
six scenarios with flow noise of 0.1 to 1 px, 24 pairs each, 3 is the best for USAC_MAGSAC, 4 for
OpenCV's PnP-RANSAC, and 2 to 4 are equal for PoseLib (``tools/benchmark.py --parts thresholds
--seed0 0 --pairs 24``)."""
MIN_INLIER_PX = 0.5
"""Smallest such residual, px. Of 84 heavy development pairs with DIS flow, which states 0.03 to
0.08 px, PnP-RANSAC and PoseLib are wrong on 41 and 36 with 0.5 px, 38 and 37 with 0.25 px, 42 and
39 with 0.1 px, 57 and 46 with 1 px (the same command, seeds 0, 900, 901, 960 and 961)."""
UNSTATED_FLOW_STD_PX = 0.5
"""Taken for the standard deviation of an estimated flow that states none, px. True flow has 0."""
OPENCV_INLIER_PX = 8.0
"""OpenCV's own limit on the residual of an inlier, px."""
SOLVER_CONFIDENCE = 0.999
"""Probability that one sample of the tuned solvers is free of outliers. By hand."""
MIN_CONSENSUS_RATIO = 0.05
"""Fraction of the sampled pixels that must be inliers: below, a consensus is chance. By hand."""
MIN_SOLVER_POINTS = 6
"""Correspondences, and inliers, that a solver needs: four always fit some pose, so they prove
nothing. By hand."""
SINGULAR_RATIO = 1e-10
"""Ratio of the information's extreme eigenvalues below which a covariance cannot be stated: a
patch of 20 px has 1e-9. By hand."""
SELF_FLOW_STD_PX = 1.0
"""How well the flow of a motion without any given flow is taken to be known, px. By hand."""

# Of the baselines on point clouds and on matched features. By hand, as an experienced user of a
# depth camera would set them; at a median depth of 2 m these are 4 m, 3 cm and 15 cm.

CLOUD_RANGE_RATIO = 2.0
"""Farthest point that is registered, in median depths: the noise of depth cameras grows with the
square of depth, and the sky of renderers is no surface."""
CLOUD_VOXEL_RATIO = 0.015
"""Side of the voxels of small_gicp, in median depths."""
CLOUD_MATCH_VOXELS = 5.0
"""Largest distance of two points that belong together in small_gicp, voxels."""
CLOUD_MIN_POINTS = 50
"""Points that a registration needs: each looks at ten neighbours."""
KISS_VOXEL_RATIO = 0.01
"""Side of the voxels of KISS-ICP, in ranges: its own rule."""
KISS_THRESHOLD_VOXELS = 2.0
"""First threshold of KISS-ICP, voxels: its default of 2 m at voxels of 1 m."""
SIFT_FEATURES = 2000
"""Features of an image that ``sift-pnp`` keeps, the strongest first."""
SIFT_RATIO = 0.8
"""Largest ratio of the distances to the nearest and the next descriptor: Lowe's (IJCV 2004)."""
SIFT_INLIER_PX = 2.0
"""Largest residual of an inlier of ``sift-pnp``, px: SIFT places features to about half a pixel."""

# Refinement on flow and depth
#
# Where no command is named: chosen by hand; ``make golden`` shows what a change does.

KERNEL_CUTOFF = 3.0
"""c of the Geman-McClure kernel, standard deviations; a pixel farther away is no inlier."""
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
the interpolation of the current map averages away. ``tests/refinement/test_covariance.py`` holds
the result to 20 % of the true noise."""
NOISE_PIXELS = 1000
"""Pixels from which the noise of a motion is estimated during the search, about."""
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
DAMPING_DECREASE = 0.1
"""Factor on the damping of Newton's and Gauss-Newton's steps after a step that was kept."""
DAMPING_INCREASE = 10.0
"""The same after a step that was taken back."""
SINGULAR_DAMPING_INCREASE = 100.0
"""The same where there was no step, the Hessian being singular."""
FAILED_DAMPING = 1e-2
"""Damping after a first step that failed, as a ratio to the Hessian's diagonal."""
FAILED_FIT_DAMPING = 1e-3
"""The same in the fits of the search and in the coarse fit."""
MIN_DECREASE = 0.25
"""Predicted decrease g^T delta of the cost, as a ratio to delta^T H delta, below which a Newton
step is not taken."""
MAX_DEPTH_SHIFT = 0.3
"""Largest correction of a log depth: the linearization in log depth holds no farther."""
FULL_STEPS = 5
"""Most Newton steps on all pixels of a pair."""
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
"""Length of the last Newton step on all pixels of a pair, standard deviations. Convergence is
quadratic: what such a step leaves is a tenth of a standard deviation."""
BATCH_STEP_TOLERANCE_STD = 4.0
"""The same of a batch."""
ROUNDED_STEP_STD = 0.05
"""Mean motion of the image, standard deviations, below which a step may be rounding: of a batch,
where it is not half as long as the shortest before it; of a pair, where it is the one after the
last."""
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
LARGEST_ODDS = 1e-3
"""A rival's fraction of the weight counts from this value to one less it, as evidence."""
MIN_CURVATURE_RATIO = 0.2
"""Smallest eigenvalue of the full second derivative, as a fraction of that of Gauss-Newton's
matrix, with which the curvature of the robust weights is believed: with few inliers it is noise."""
SMALLEST_LEFT_OVER = 0.25
"""Smallest fraction of the scores' variance that the fit is taken to leave in blocks of tiles."""
MODEL_SHARE = 0.01
"""Fraction of the model's own covariance that is always added: exact data leave no residuals from
which the error of the model could be estimated."""

# Hypotheses and their selection


class Annealing(NamedTuple):
    """How the scale of a robust kernel shrinks during a fit.

    Attributes:
        start_px: first scale, px; where it follows from the residuals, its largest value.
        end_px: last scale, px.
        ratio: each scale over the one before.
        steps: Gauss-Newton steps at each scale, at most.
    """

    start_px: float
    end_px: float
    ratio: float
    steps: int


# Where no data and no command are named, a number of this section was chosen by hand;
# ``make golden`` shows the effect of a change.

CANDIDATE_ANNEALING = Annealing(start_px=64.0, end_px=0.7, ratio=0.4, steps=2)
"""Of the fit of a window, and of a pose that the caller hands in."""
CANDIDATE_MIN_START_PX = 1.0
"""Smallest first scale of that fit, px, even where the residuals are smaller."""
START_SCALE_FACTOR = 1.5
"""First scale about a pose that is handed in, as a multiple of its median residual."""
NEAR_START_PX = 1.5
"""First scale of a second fit about a pose that is handed in, px: where most of the
image moves, a wide kernel would leave even the right motion."""
BEST_CANDIDATES_ANNEALING = Annealing(start_px=1.5, end_px=0.7, ratio=0.4, steps=3)
"""Of the candidates of a round that have the largest scores."""
FOUND_MOTION_ANNEALING = Annealing(start_px=0.7, end_px=0.5, ratio=0.4, steps=3)
"""Of a motion that won its round, before its noise is estimated."""
SHARP_SCORE_PER_PX2 = 44.4
"""Scale of the sharp half of a candidate's score, 1 / px^2: 0.15 px count half."""
BROAD_SCORE_PER_PX2 = 1.2
"""Scale of the broad half of that score, 1 / px^2: 0.9 px count a quarter."""
REESTIMATED_MIN_SCORE = 0.95
"""Smallest score of a motion after the fit with its own noise, over that before; below
it that fit is discarded."""
DUPLICATE_CANDIDATE = 2e-4
"""Largest difference between the entries of two poses that are one candidate: rad, and
translation over the typical depth."""
DISTINCT_MOTION_PX = 3.0
"""Mean difference of the ego flows of two motions above which they are two, px at a
width of 1024."""
MAX_PIXEL_DISTANCE_PX = 1e3
"""Largest difference of the ego flows of two motions at a pixel, px; also that of a pixel
which only one of them leaves in front of the camera."""
INLIER_REMOVAL_GAIN = 2.5
"""Weight that a pixel loses when a motion is removed, in units of its robust weight under
that motion. With a gain of 1 enough would remain to find the motion again."""
MIN_INLIER_NOISE_PX = 0.05
"""Smallest flow noise by which inliers are decided, px: below it all motions count as
equally sharp."""
MIN_PIXEL_WEIGHT = 0.05
"""Weight of a pixel up to which a window leaves it out; 1 is that of an untouched one."""
MIN_WINDOW_PIXELS = 20
"""Fewest pixels of a window that is fitted."""
MIN_WINDOW_WEIGHT = 12.0
"""Smallest sum of the weights of such a window."""
GLOBAL_SAMPLE_PERIOD = 3
"""One of so many minimal samples is drawn from all pixels, the others locally."""
LOCAL_SAMPLE_HEIGHT = 0.5
LOCAL_SAMPLE_WIDTH = 0.4
"""Region of a local sample about its first pixel, over the height and width of the image."""
MASK_RAMP_START = 0.4
"""Probability of being static up to which a pixel has no weight in a refit."""
MASK_RAMP_END = 0.9
"""Probability of being static from which a pixel has full weight; linear in between."""
MIN_COVERAGE = 0.02
"""Fraction of the usable weight that a mask must leave for a refit inside it."""
MAX_SCORE_DEFICIT = 3.0
"""Largest difference from the best score at which a candidate is fitted again, nats: it is then a
twentieth as probable."""
MAX_SCORE_MARGIN = 8.0
"""Margin of the best score where there is no other motion, and the largest that counts,
nats."""
BORDER_WIDTH = 0.06
"""Width of the band along the border of the image for the cue of border coverage, over
the shorter side of the image."""
CUE_MIN_INLIER_RATIO = 0.01
"""Added to inlier ratios before their logarithm is a cue: none at all is finite."""
CUE_MIN_DEPTH_STD = 0.03
"""Added in quadrature to the standard deviation of log depth before its logarithm is a
cue."""

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
MAX_PRIOR_DISTANCE = 4.5
"""Distance from the flow's motion, in standard deviations of its inflated covariance, beyond which
the motion by the images is refused."""
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
IMAGE_BLUR_PX = 1.0
"""Standard deviation of the blur of both images, px."""
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

# The motion by images and depth maps alone, without flow.

DIRECT_PRIOR_STD = (0.3, 0.15)
"""Standard deviations of the translation, m, and of the rotation, rad, of the motion without the
images: so wide that it does not decide."""
NOISE_SHIFT_PX = 0.25
NOISE_GREY = 0.5
"""A point follows a motion where its residual is explained by a shift of the image, px,
and by noise, grey levels (standard deviations)."""
SHARED_DEPTH_NOISE = 0.03
"""Standard deviation of a depth, relative, that its neighbours share: from a keyframe it moves a
point beside where it is seen. With it the images of a moving stereo camera (devices/d435_quiet)
leave up to 0.2 of their texture unexplained from a keyframe, without it 0.36, and those of a walk
that follows a slow object 0.24 to 0.38 either way. Between neighbours it is not added: it would
explain a slow object. Unfitted."""
MAX_UNEXPLAINED = 0.2
"""Fraction of the texture in unexplained regions up to which the images from a keyframe confirm
the motion of a step. On the same two. Unfitted."""
MIN_FOLLOWING = 0.5
"""Product of the two robust factors of a point, by grey value and by depth, above which it follows
the motion."""
LIGHT_SIDE = 3
REGION_SIDE = 5
"""Sides of the squares, in points of the grid, over which the change of light is averaged and over
which a region is called explained or not."""
FLAT_GRADIENT = 4.0
"""Gradient, grey levels over two pixels, whose texture counts half: a smooth surface looks the same
wherever it went."""
UNEXPLAINED_FLOOR = 0.01
"""Fraction of the texture in unexplained regions that is added before the logarithm is taken."""

# Whether images and depth maps contradict a motion.

CONSISTENT_WEIGHT = 0.5
"""Robust weight of a pixel that an answer takes for static."""
MIN_DEPTH_EIGENVALUE = 1e-3
"""Ratio to the largest eigenvalue of the (scaled) information of the depth maps, below
which they do not determine a direction of the motion."""

# Wide steps

MIN_FLOW_COVERAGE = 0.1
"""Fraction of the flow that is the same in both directions, below which it is not searched: 0.0 to
0.05 of steps that are too wide, 0.2 and more of others (turning Kinect, rooms, people on a tripod,
turned windows; ``tools/benchmark_wide_steps.py``). It saves 350 ms of a step that is too wide."""
MATCH_FEATURES = 800
"""SIFT features of an image, for a step that flow cannot follow: 40 ms on one core. Chosen by
hand, as all of this section; ``tools/benchmark_wide_steps.py`` shows the effect of a change."""
MATCH_WIDTH = 400.0
"""Width to which images are reduced before features are matched, px: 35 ms instead of 90 for a
pair at 640x480, and as many wide steps are right (78 and 77 of 86)."""
MATCH_RATIO = 0.8
"""Largest ratio of the distances of the best and the second best match (Lowe, IJCV 2004)."""
MATCH_RESIDUAL_PX = 2.0
"""Largest residual of a match that follows a motion, px at a width of 640."""
MATCH_MIN_INLIERS = 15
"""Fewest matches that follow a motion."""
MATCH_MAX_MOTIONS = 2
"""Motions of a pair that are sought: the scene's, and a moving object's before it."""
GUIDED_MIN_TEXTURE = 3.0
"""Smallest standard deviation of grey levels over a patch where flow that starts from a motion
counts: above the noise of usual cameras."""

# Networks

# Where no data and no command are named, a number of this section was chosen by hand;
# ``make golden`` shows the effect of a change.

SHARPNESS = 4.0
"""Weights of pixels in a fit are exp(-4 s), s the log scale of their uncertainty. Errors
of pixels on one moving object are alike, and an object on two thirds of the image must
not outweigh the rest. On development pairs 8 gave the same answers as 4."""
SEED_SHARPNESS = 1.0
"""Weights of pixels in a refinement are exp(-s), over the largest: for PWVO the probability of a
pixel to be static. ``tools/sentence.py`` shows the effect of a change."""
MIN_SEED_WEIGHT = 1e-2
"""Smallest weight of a pixel in the seed of a refinement, over the largest one: pixels
of large uncertainty decide only where there are no others."""
MIN_FIT_SCALE = 1e-4
"""Smallest scale of the kernel of a fit weighted by uncertainty, over the focal length:
0.1 px at 1000 px."""
MIN_NETWORK_PIXELS = 64
"""Fewest pixels of a network's input with flow and depth."""
INVALID_LOG_SCALE = 3.0
"""Smallest log scale of a pixel without flow or depth: 20 degrees or 20 m."""
MAX_NETWORK_SCALE_DEG = 2.0
"""Uncertainty of a rotation above which the answer of a network alone is degraded,
degrees: more than most cameras turn between two frames."""
UNSTATED_ROTATION_DEG = 1.0
"""Uncertainty of a rotation by a network that states none, degrees: a usual motion."""
UNSTATED_TRANSLATION_M = 0.3
"""Uncertainty of a translation by a network that states none, m."""

# Data, runs and reports

RIGHT_FACTOR = 3.0
"""A motion is right up to so many times the error of the fit to the true static
pixels, where flow, depth or the ground truth allow no better than
:data:`WRONG_PX`. Chosen by hand; labels of PWVO's training and of
``tools/benchmark_semi_real.py``."""
MAX_RIGHT_PX = 3.0
"""Mean error of the ego flow, px, from which a motion is wrong in any case. Chosen by
hand; used with :data:`RIGHT_FACTOR`."""
MAX_STAMP_DIFFERENCE_S = 0.02
"""Largest difference of time stamps that belong together, s: the value of the TUM tools, which is
well below the 33 ms between the frames of a depth camera. Chosen by hand."""
MOVING_PX = 1.0
"""Difference of the true flow and the true ego flow, px, above which a pixel moves by itself. It is
the unit of ``WRONG_PX`` too; chosen by hand."""
MOVING_FLOW_STDS = 3.0
"""Standard deviations of the flow beyond which a difference is no noise, in pictures."""
UNUSED_WEIGHT = 0.5
"""Weight of a pixel below which the estimate does not rest on it, in pictures."""
MOVING_GREY_LEVELS = 3.0
"""Grey levels by which a region has to fit its flow better than the camera's motion, to be outlined
in pictures. Chosen by hand; ``hybridvo show`` on a scene with smooth walls shows its effect."""
MIN_REGION_AREA = 0.01
"""Fraction of the image that an object has to fill to be outlined."""
MIN_REGION_THICKNESS = 0.02
"""Fraction of the image's width below which a region is too thin to be outlined."""
MIN_SCALE_PAIRS = 6
"""Pairs with a true motion from which ``doctor`` judges the scale of depth. Chosen by hand."""
MAX_SCALE_ERROR = 0.2
"""Relative error of the scale of depth with which ``doctor`` is content: noisy ground truth over
short motions errs by half of that (``hybridvo doctor DIR`` on the recordings of TUM)."""
MIN_PATH_LENGTH_M = 0.01
"""Length of a true motion, m, from which it shows the scale of depth: below, motion capture errs by
as much."""
MAX_CONTRADICTED = 0.2
"""Fraction of the pairs whose flow may contradict their images without a report. By hand."""
DISPARITY_STD_PX = 0.5
"""Standard deviation of a disparity of semi-global block matching, px. It prefers whole pixels by
up to 0.3 px, whatever the texture: planes of disparity 10 to 11 in steps of 1/8, as
``tests/data/test_stereo.py`` renders them. The rest is for occlusion and weak texture, by hand."""
MAX_DISPARITY_PX = 128
"""Disparity that is searched, px: at KITTI's focal length and baseline all beyond 3 m, at EuRoC's
beyond 0.4 m. Chosen by hand."""
MAX_STEREO_INTERVAL_S = 0.005
"""Between the stamps of the two images of a stereo pair, s: cameras that are triggered together
state the same one, to a few tenths of a millisecond (EuRoC: equal). Chosen by hand."""
MAX_FOOTPRINT_PX = 32
"""Pixels of colour, along a row or a column, that one pixel of depth may cover when depth is
registered: sensors have 1 to 8, a damaged map would cover the whole image. Chosen by hand."""
MIN_DEPTH_EDGE = 0.05
"""Relative step of depth between neighbours that an image shows as an edge.
Chosen by hand; ``hybridvo doctor DIR`` shows its effect."""
MIN_TEXTURE_GRADIENT = 2.0
"""Grey levels per pixel from which a gradient is above the noise of a camera.
Chosen by hand; ``hybridvo doctor DIR`` shows its effect."""
STRONG_EDGE_PERCENTILE = 95
"""Percentile of the gradients from which edges are strong enough to judge focus.
Chosen by hand; ``hybridvo doctor DIR`` shows its effect."""
MAX_EDGE_GRADIENT = 10.0
"""Grey levels per pixel at which gradients are cut off, so that one bright edge does not count
more than others.
Chosen by hand; ``hybridvo doctor DIR`` shows its effect."""
MAX_EDGE_DISPLACEMENT = 0.15
"""Fraction of width and height within which a displacement is looked for.
Chosen by hand; ``hybridvo doctor DIR`` shows its effect."""
EDGE_SURROUNDINGS_PX = 31
"""Side of the surroundings of a pixel, whose mean gradient is subtracted, pixels.
Chosen by hand; ``hybridvo doctor DIR`` shows its effect."""
STEREO_BLOCK_PX = 5
"""Side of the blocks of two images that are compared, px. Chosen by hand."""
MIN_MATCHED_RATIO = 0.5
"""Fraction of the poses that must match in time; below it the clocks or units differ.
Chosen by hand."""
MOVING_BLUR_PX = 5
"""Side of the window in which grey levels are averaged before regions are outlined in pictures, px.
Chosen by hand."""

DEPTH_SCALE_STD = 0.05
"""Standard deviation of the log scale of a frame's depth by a network, about the network's mean:
metric depth networks change their scale by some percent from frame to frame. Chosen by hand;
``tests/onnx_networks/test_breathing.py`` shows what comes of wobbles of this size."""
DEPTH_SCALE_DRIFT = 0.005
"""Standard deviation of the log ratio of two depth maps over static pixels, as an estimate of their
scales. A network draws far things too near, and a car that comes closer sees its scale grow:
+.0015 a frame on ``data/devices/kitti00_network_depth``, which noise alone (.001) would let pile
up over 50 frames and not over 10. There, 53 m err by .77 m in the median and 1.53 at most
(without the filter .77 and 1.58, with .001 1.26 and 1.76), and the lengths of neighbouring steps
differ by 2.3 % (2.7 %, 2.3 %)."""

# -- depth that is rigid and false -------------------------------------------------------

EXACT_SURFACE = 2e-3
"""Relative distance in depth up to which a pixel lies on a surface. Of real walls that fill the
view 64 % at most do (``data/real_static/rooms_110``, frames 79 to 89, structured light), of a
D435's 40 %."""
MIN_ON_SURFACE = 0.78
"""Fraction of the pixels with depth that must lie on it. Unfitted: most of them, beside holes and
edges that were filled otherwise."""
OFF_SURFACE_PX = 0.5
"""Distance between the flow and that of the surface, px, below which a pixel moves with it.
Unfitted; so are the next three."""
OFF_SURFACE_FLOW = 0.02
"""The same as a fraction of the flow: what the surface's inexactness may add."""
OFF_SURFACE_GAIN = 1.5
"""How much better the images must match along the flow than along the surface's."""
OFF_SURFACE_GREY = 2.0
"""And by how many grey levels more."""
MAX_OFF_SURFACE = 0.03
"""Fraction of a surface's pixels that may move otherwise. Constant, tilted, ramp and nearly
constant maps before 16 rendered pairs: 8 to 63 %; before images of a Kinect (fr1_xyz,
redwood) 3 to 31 %; rendered walls and floors 0."""

# -- a focal length that is off ----------------------------------------------------------

MIN_FOCAL_STEPS = 30
"""Motions before which nothing is stated of the focal length. Unfitted."""
MIN_FOCAL_INFORMATION = 1e4
"""Sum of the informations on the log focal length below which nothing is stated: a camera that
hardly moves shows none. A Kinect that turns gathers 1e6 in 49 motions, one that stands
(``devices/xtion_hands``) 5e2 in 23."""
MAX_FOCAL_ERROR = 0.03
"""Log of the focal length by which it may be off: what distortion that was not taken out and a
rolling shutter look like. Unfitted."""
FOCAL_SIGMAS = 3.0
"""Standard deviations by which it must be off by more than that. Unfitted."""

# -- frames that a camera hands out again ------------------------------------------------

STANDING_FLOW_PX = 0.5
"""Mean flow of the expected motion, px, below which an image that repeats may be that of a
camera that stands: either answer is then the same within a pixel. Unfitted."""
EQUAL_DEPTH = 2e-3
"""Median relative difference between a depth map of an earlier frame and what the frame must
show, below which the old map is as good as a new one: below a sensor's noise. Unfitted."""
REPEATED_RIGHT = 0.5
"""Probability of a motion that depth alone or the motion before give while the image is an old
one. Unfitted."""

# -- live cameras: chosen by hand, as what a user who waits for a pose can bear ----------------

LIVE_WIDTH_PX = 640
"""Columns of a live image where no preset states otherwise, px: every camera that has a driver
offers this size, and two cores keep up with it."""
LIVE_HEIGHT_PX = 480
"""Rows of such an image, px."""
LIVE_RATE_HZ = 30
"""Frames a second that are requested of a live camera: what all of them offer at that size."""
MAX_FRAME_AGE_S = 0.5
"""Age from which a frame is dropped, s: it shows where the camera was. Sensors hand a frame out
after 0.02 to 0.1 s; above half a second something has held it up."""
MAX_OLD_FRAMES = 10
"""Frames in a row that are dropped for their age; then the camera itself is slow, or its clock is
wrong, and its frames are taken."""
MAX_CLOCK_JUMP_S = 1.0
"""Difference between the time that passed by the stamps and by the arrival of two frames, s, from
which the camera's clock has jumped. USB holds frames up by some tenths of a second."""
MAX_STANDING_STAMPS = 5
"""Frames in a row whose stamps do not rise, from which on the camera has no clock: drivers hand
a frame out two or three times."""
LIVE_WAIT_S = 0.1
"""Longest wait for a frame before a request to stop is looked for, s: for a person, at once."""
MAX_SILENCE_S = 3.0
"""Time without a frame after which a camera is closed and opened again, s: RealSense and OAK need
up to two seconds for their first frame."""
FIRST_RETRY_S = 1.0
"""Time until a lost camera is opened again, s; it doubles with every attempt that fails."""
MAX_RETRY_S = 8.0
"""Longest time between two such attempts, s: a plug that is put back in is noticed soon enough."""
MAX_ABSENCE_S = 60.0
"""Time without a frame after which a live run ends, s: long enough to plug a camera in again."""
MAX_CLOSING_S = 5.0
"""Time that a camera has to stop, s; one that hangs is left alone, and the results are written."""
LIVE_RECORDING_S = 600.0
"""Time over which the images of a Rerun recording are distributed where a live run has no end, s:
ten minutes, with an image every second."""
RATE_STEPS = 30
"""Steps over which the frames a second and the ages on the screen are counted: one second."""

# What other sensors measure before the images are used.

GYRO_NOISE_DENSITY = 2e-3
"""Noise of a gyroscope, rad/s/sqrt(Hz): ten times the data sheet of EuRoC's ADIS16448, for its bias
and the delay of its stamps. By hand."""
GYRO_HOLD_S = 0.1
"""Longest time for which a rate of a gyroscope stands, s: the slowest give 50 a second. By hand."""
UNKNOWN_SPEED = 1.0
"""Standard deviation of an unknown velocity, m/s along each axis: walking. By hand."""
