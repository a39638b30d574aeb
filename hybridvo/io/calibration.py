"""Numbers of recordings and cameras that decide: value, unit, data, how to find them again."""

CENTRAL_PRINCIPAL_POINT = (0.35, 0.65)
"""Place of the principal point, as a fraction of the width and of the height, outside of which
``doctor`` and ``run`` suspect intrinsics of another resolution: those of 43 recordings lie at 0.47
to 0.54, of twice the resolution at 1 (``hybridvo doctor DIR``)."""
MAX_STAMP_DIFFERENCE_S = 0.02
"""Largest difference of time stamps that belong together, s: the value of the TUM tools, which is
well below the 33 ms between the frames of a depth camera (fr1_rpy: ``hybridvo doctor DIR``)."""
DISPARITY_STD_PX = 0.5
"""Standard deviation of a disparity of semi-global block matching, px. It prefers whole pixels by
up to 0.3 px, whatever the texture: planes of disparity 10 to 11 in steps of 1/8, as
``pytest tests/io/data/test_stereo.py`` renders them. The rest is for occlusion and weak texture."""
MIN_LIVE_COLUMNS = 200
"""Columns below which images are not made smaller, px: ``tools/benchmark.py live`` shows whether
the path holds at 213."""
SMALL_FLOW = "fast"
"""Preset of DIS on images that were made smaller: 12 ms on 320x240, against 83 of ``medium``, which
goes down to the pixels of small images (fr1_rpy, smallest of 19 pairs, loaded machine). Whether the
path holds with it shows ``tools/benchmark.py live``."""
