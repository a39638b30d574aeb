"""Numbers fitted on data: value, unit, data, and how they are found again.

The probabilities of being right are logistic in their evidence (for the selectors the gap between
the best score and that of another motion): weights, and one that stands alone. ``python
tools/calibrate.py`` fits them on 1000 pairs of the development recordings of
:mod:`hybridvo.synthetic.semi_real`, the heavy development scenes, seeds 900 to 905, with DIS flow,
and 100 scenes without an answer: "the same pairs" below.
"""

CUES_RIGHT = (0.29, 0.73)
"""Of the cue scores: 838 of 1061 right, AUROC .73, calibration error .09."""
NO_MOTION = -2.0
"""The selector's score of no motion being the camera's. In training it was 0, with which two equal
motions would be believed; on 1500 development pairs AUROC .870 with 0, .873 with -1 and -2, .866
with -3 (``tools/calibrate.py`` after a change)."""
SELECTOR_RIGHT = (0.71, 1.19)
"""Of the selector's: 914 right, AUROC .97, calibration error .01."""
PWVO_RIGHT = (0.70, 0.33, 0.28, -0.97)
"""Of PWVO's, refined: lead, log agreement, log odds; 1005 of 1218 right, AUROC .87, error .02."""
DIRECT_RIGHT = (-11.33, -1.56, 0.05)
"""Of a motion found without flow, in its standard deviation, px, and the log of the share of the
texture in unexplained regions: 1480 of 3142 right, AUROC .90, calibration error .04."""
UNAMBIGUOUS_RIGHT = 0.99
"""Share of right answers where the first motion explains nearly all that is usable."""
CUE_WEIGHTS = {
    "share": 0.35,
    "border": 0.65,
    "extent": 1.29,
    "behind": 2.11,
    "noise": -1.38,
    "prior": 1.0,
}
"""Weights of the cues of :mod:`hybridvo.hypotheses.selector`, a multinomial logit of which motion
is the camera's, on such pairs (before they came in two sizes), the heavy scenes with true flow
and the scenarios, seeds 500 to 511 (``--cues --pairs 100``). The prior's is by hand: nats."""
MIN_PROBABILITY = 0.86
"""Probability of being right below which a motion is degraded: one in eight of the right ones
beside recorded movers is, 14 of 44 wrong ones are not (``tools/benchmark_semi_real.py --split
development --pairs 800``). Two motions with the same score have 0.77, and must not be believed."""
DIRECT_PROBABILITY = 0.95
"""That from which flow is not asked: 3 of 353 such motions on the same pairs are wrong.
Below, flow's answer is taken."""
UNAMBIGUOUS_COHERENCE = 0.5
"""Spatial correlation of the residuals above which a motion of most pixels may be a compromise:
0.02 for independent noise, to 0.4 for DIS flow of static scenes, above 0.6 where movers bend it."""
UNAMBIGUOUS_BEND_PX = 0.15
"""Coherent part of the residuals, px at a width of 1024, above which it may be one as well."""
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

LEAST_LEAD = 0.0025
"""Mean flow, share of the width, by which images or depth maps must lead away from a motion at
least before they contradict it: 1.6 px of 640."""
IMAGE_LEAD = 0.04
"""The same as a share of the motion's own flow. DIS flow of the recordings in ``tools/golden.py``
is at 0.03 in the median and 0.08 at most, flow of half its size at 1."""
IMAGE_LEAD_GAIN = 1.25
"""How much smaller the residual of the images must be where they lead: DIS flow of static
recordings 1.0 to 1.3, flow of half its size 1.5 to 12 (36 pairs each)."""
DEPTH_LEAD = 1.0
"""Mean flow to which the depth maps lead, as a share of the motion's own: up to 0.6 of a turning
Kinect, whose depth is taken at another time than its image; 1 and more where the image is that of
another time altogether."""
DEPTH_LEAD_STD = 5.0
"""Standard deviations that this must be: of right motions of rendered pairs 3.4 at most, of frozen
images 6 and more, with the noise of structured light."""
CONTRADICTED_RIGHT = 0.1
"""Probability of a motion that images or depth maps contradict: none of 57 was right."""
MIN_DEPTH_SHARE = 0.002
"""Share of a frame's pixels with valid depth below which no motion starts from it: sparse laser
depth covers 0.04 and more, a covered depth camera leaves single pixels."""
NO_MOTION_PROBABILITY = 0.05
"""Probability of being right below which a motion is not applied to the path."""
KEYFRAME_FLOW = 0.05
"""Largest mean ego flow from a keyframe, as a share of the image's width; DIS follows a tenth."""
KEYFRAME_AGE = 12
"""Frames that a keyframe is used for at most: so many are kept."""
KEYFRAME_CORRELATION = 0.5
"""Correlation of the errors of two motions from one keyframe, whose noise they share."""
WRONG_PX = 1.0
"""Mean error of the ego flow, px at native size, beyond which a motion is called wrong where the
truth is exact (rendered): 1 px is what a user of a map sees. The limit grows with the truth's."""
TRUTH_NOISE = {
    "tum": (0.4, 0.004),
    "7scenes": (0.15, 0.005),
    "folder": (0.15, 0.005),
    "kitti": (0.1, 0.04),
}
"""What the truth between two frames errs by, degrees and metres, by the reader's kind: motion
capture, the paths of a SLAM system (also taken for one's own recording), GPS with an inertial unit.
Chosen so that a right motion stays below the limit in 19 of 20 pairs; 95th percentile of
``epe_l2_px`` in ``steps.csv`` of ``hybridvo run DIR`` (status ok), and the limit there, px: fr1_xyz
3.2 (4.1), fr1_rpy 5.2 (4.2), rooms_110 1.3 (1.6), kitti02 and kitti06 at half size 0.9 and 1.2 (1).
``7scenes`` was not measured: its truth is of a SLAM system too."""
MAX_COORDINATE_M = 1e12
"""Largest coordinate of a position that is evaluated, m: a double resolves 0.1 mm there, beyond it
errors of millimetres are rounding, and squares of 1e160 overflow."""
MIN_VALID_DEPTH = 0.1
"""Share of the pixels with depth, in the median frame, from which ``doctor`` is content. Recordings
that give right motions have 0.17 (lidar) to 1; with a tenth of the pixels motions are degraded."""
EMPTY_DEPTH = 0.01
"""Share below which a frame is one without depth."""
MIN_TEXTURE = 0.03
"""Share of the pixels with a gradient above 2 grey levels. Recordings have 0.17 to 0.9."""
MIN_FOCUS = 0.4
"""Second over first derivative at strong edges: 0.9 to 1.9 on 16 recordings and rendered scenes,
0.16 to 0.27 with a Gaussian blur of three pixels over them."""
REGISTRATION = (0.02, 6.0, 1.5)
"""Displacement of the edges of depth beside those of the image, as a share of the longer side, from
which ``doctor`` says so; standard deviations of the agreement over all displacements, above which
the best one is believed; and how much better it is than none. Where it is believed, 11 recordings
and rendered scenes have 0 to 0.012 (8 px of 640: fr1_xyz), and moved by 60 px the same and 60 px;
stereo and lidar depth have no clear best one."""
LATE = (1.5, 0.1)
"""Factor on the median interval above which one is a gap, and share of gaps that is too many."""

# Below, without a unit: fitted on the development seeds of the scenarios (``tools/benchmark.py``),
# on rendered walks with DIS flow, and on the real samples.

FEW_TILES = 48
"""With fewer tiles the correlation between errors is hardly known; more of it is then assumed."""
CLUSTERED = 0.6
"""Share of the clustered matrix in the meat, the rest is that of independent errors scaled to the
same mean. Alone the few blocks make weak directions too certain at times (4 of 420 pairs)."""
LONG_GROWTH = (1.7, 2.2)
"""Growth of the variance of sums over blocks four tiles wide against one tile's, in units of
independent errors, between which errors come to count as reaching beyond the blocks: 1.0 of
independent noise, 1.0 to 1.3 of the cells, 2.2 to 3.1 with DIS flow."""
ABSORBED = 2.0
"""The exponent of the growth is taken so much larger: what errors have in common over the image the
fit takes into the motion. Median squared error in units of the covariance, 5.3 expected, on 240
pairs with DIS flow: 12 with 1.5, 7 to 9 with 2, 6 to 8 with 2.5."""
DOUBTFUL_SPREAD = 0.15
NO_SPREAD = 0.35
"""Of the log ratio of two depths: spread from which an answer is degraded, and from which it is
none. Real sensors and rendered depth with DIS flow measure 0.001 to 0.018, noise 0.49 to 0.6."""
MIN_TILES = 24
"""Tiles of the whole image in which usable pixels lie, below which a covariance cannot be
trusted: depth errs alike over some 50 px (3 of 59 development lines were beyond 3 sigma)."""
EVEN_PARTS = 0.7
"""Dispersion of the parts' scores, as shares of the model's, below which they agree: rendered pairs
have 0.25 in the median, 0.55 at the 90th percentile; with a rolling shutter 1.0 and 2.0."""
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

# Refinement on flow and depth

# Hypotheses and their selection

# Photometric refinement

# Networks

# Data, runs and reports

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
