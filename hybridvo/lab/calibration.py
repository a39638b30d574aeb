"""Numbers of scenes and evaluation that decide: value, unit, data, how to find them again."""

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

# Data, runs and reports

RIGHT_FACTOR = 3.0
"""A motion is right up to so many times the error of the fit to the true static
pixels, where flow, depth or the ground truth allow no better than
:data:`WRONG_PX`. Chosen by hand; labels of PWVO's training and of
``tools/benchmark.py semi_real``."""
MAX_RIGHT_PX = 3.0
"""Mean error of the ego flow, px, from which a motion is wrong in any case. Chosen by
hand; used with :data:`RIGHT_FACTOR`."""
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
MIN_MATCHED_RATIO = 0.5
"""Fraction of the poses that must match in time; below it the clocks or units differ.
Chosen by hand."""
MOVING_BLUR_PX = 5
"""Side of the window in which grey levels are averaged before regions are outlined in pictures, px.
Chosen by hand."""

# Windows of frames

WINDOW_STEPS = 40
"""Most Gauss-Newton steps of a window of frames: each halves the distance to the solution at least,
and a gradient needs it to the precision of the numbers. By hand."""
WINDOW_STEP_TOLERANCE_STD = 0.1
"""Length of the last step of a window with more unknowns than poses, standard deviations: what a
step leaves may be as long as it. Unfitted."""
WINDOW_EDGE_STEPS = 5
"""Gauss-Newton steps that bring the motion of each edge to the focal length and the scales of its
window, before both are compared. Unfitted."""
