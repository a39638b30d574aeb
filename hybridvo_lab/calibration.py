"""Numbers of scenes and evaluation that decide: value, unit, data, how to find them again."""

WRONG_PX = 1.0
"""Mean error of the ego flow, px at native size, beyond which a motion is called wrong where the
ground truth is exact (rendered): 1 px is what a user of a map sees. The limit grows with its
error. ``tools/golden.py --quick --only ladder_evaluation`` shows the effect of a change."""
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
RIGHT_FACTOR = 3.0
"""A motion is right up to so many times the error of the fit to the true static
pixels, where flow, depth or the ground truth allow no better than
:data:`WRONG_PX`, as ``tools/benchmark.py semi_real`` and the labels of PWVO's training count."""
MAX_RIGHT_PX = 3.0
"""Mean error of the ego flow, px, from which a motion is wrong in any case, there too."""
