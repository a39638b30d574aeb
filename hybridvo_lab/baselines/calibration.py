"""Numbers of other estimators that decide: value, unit, data, how to find them again."""

INLIER_STDS = 3.0
"""Largest residual of an inlier, in standard deviations that the flow states (median over the
sampled pixels): of a residual in two directions 99 % are below. Of 1, 2, 3, 4, 6 and 8 on
six scenarios with flow noise of 0.1 to 1 px, 24 pairs each, 3 is the best for USAC_MAGSAC, 4 for
OpenCV's PnP-RANSAC, and 2 to 4 are equal for PoseLib (``tools/benchmark.py methods
--parts thresholds --seed0 0 --pairs 24``)."""
MIN_INLIER_PX = 0.5
"""Smallest such residual, px. Of 84 heavy development pairs with DIS flow, which states 0.03 to
0.08 px, PnP-RANSAC and PoseLib are wrong on 41 and 36 with 0.5 px, 38 and 37 with 0.25 px, 42 and
39 with 0.1 px, 57 and 46 with 1 px (the same command, seeds 0, 900, 901, 960 and 961)."""
