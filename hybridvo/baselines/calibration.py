"""Numbers of other estimators that decide: value, unit, data, how to find them again."""

# Of the baselines whose largest residual of an inlier follows the flow's noise.

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
