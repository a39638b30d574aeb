"""Numbers of the judge: value, unit, data, and how they are found again.

The probabilities of being right are logistic in their evidence (for PWVO the margin between the
best score and that of another motion): weights, and one that stands alone. ``python
tools/calibrate.py`` fits them on the makers of ``tools/maker_pairs.py`` that are for calibration,
each with the same weight: clips and tripod recordings of others, the development recordings of
``hybridvo_lab.synthetic.semi_real``, heavy scenes and an escalator, and scenes without an
answer.
Where "the same pairs" are named, they are 1000 of the development recordings, the heavy scenes of
seeds 900 to 905 with DIS flow, and 100 scenes without an answer.
"""

CHOICE_RIGHT = (0.38, 0.95, -1.12, 0.55, -0.72)
"""Of a motion chosen among all that were found in the flows of a pair, in the evidence of
:class:`hybridvo.hypotheses.select.ChoiceEvidence`: 963 of 1012 right, after one, two and three
flows, on ten makers, each of which counts alike (``tools/calibrate.py --choice --pairs 60``). Each
maker judged by a fit on the others: AUROC .93, calibration error .01, 12 of 49 wrong ones above .9,
nine of these of two recordings in one view, where 17 of 146 are wrong."""
CUES_RIGHT = (0.97, 2.80, 2.12, 4.49, 2.28)
"""Of the evidence of the cues (:class:`hybridvo.hypotheses.select.CueEvidence`). 396 of 475
right on 260 semi-real pairs, the heavy ones, static recordings, scenarios and 15 pairs of unrelated
images (``tools/calibrate.py --pairs 260``): AUROC .86, calibration error .03. By the margin alone,
with a large one where there is no other motion, it was .62 and .11, and all unrelated images were
believed."""
DIRECT_EXACT = (-3.63, 2.36, -3.52, -0.72, -20.02)
DIRECT_OF_SCENE = (-1.93, 0.38)
"""Of a motion found without flow: that it is the motion of one thing, in the evidence of
:class:`hybridvo.solver.aligned_points.DirectEvidence`, and that the thing is the scene, in the
last of it alone. Their product is fitted, and the first with the certainty of a belief where that
was asked (``tools/calibrate.py --direct --pairs 24``): 5426 of 6734 right, where right is an error
of less than a quarter of a pixel of 320 columns, or of three times that of a fit to the true static
pixels. Each maker judged by a fit on the others: AUROC .985, calibration error .01; 7 of 1308 wrong
ones are above .95, and 978 right ones below. Without the fraction of the texture that is left
unexplained AUROC was .962, with 2094 right ones below."""
CERTAINTY_BONUS = 2.0
"""Nats that are added to the certainty of a belief where a motion of what it holds static is
judged: films say 10 (``tools/calibrate.py --direct``), but in none of them is a whole belief wrong
from the start."""
DIRECT_INFLATION = 3.0
"""Factor on the covariance of a motion by images and depth maps alone. The squared error of its
edges in units of the covariance should be 5.3 in the median. Without the factor it is 8.5 on six
tripods and 19.3 on TartanAir: the tripods alone ask for 1.6, TartanAir alone for 3.6. On four
rendered walks, whose noise is milder than a sensor's, it is 1.9 (``tools/benchmark.py sigmas``
shows a change)."""
DIRECT_PROBABILITY = 0.95
"""That from which no flow is computed. From .9 on, 14 instead of 7 steps of clips with large movers
are wrong and ``ok`` (``tools/benchmark.py memory_unseen``, without memory), and two more escalators
of 60, while a turning Kinect needs flow in 29 instead of 41 of 99 frames."""
AGREEMENT_RIGHT = 0.25
"""Weight of the log of how far a refined motion agrees with the one that was chosen, beside the
log odds of the choice. It was fitted on 458 answers beside a margin alone."""
WITHOUT_IMAGES_RIGHT = 0.5
"""Probability of a motion that no image confirms: by depth maps alone, where all points are in view
and follow it, or as it was expected."""
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
another time altogether. Of 18 pairs of a Kinect, a D435 and a HoloLens whose second image is the
first one within a grey level, 18 are wrong and ``ok`` where the depth maps are not asked, and 1
where they are; of dark images with spots on the lens 16 and none."""
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
NO_MOTION_PROBABILITY = 0.05
"""Probability of being right below which a motion is not applied to the path."""

# Whether images and depth maps contradict a motion.

# -- depth that is rigid and false -------------------------------------------------------
#
# Without the doubt of these numbers a rendered house of bare walls (189 frames) goes from 11 to 35
# cm: the images alone are sure where bare walls leave a direction open, and a doubt asks for flow.

EXACT_SURFACE = 2e-3
"""Relative distance in depth up to which a pixel lies on a surface. Of real walls that fill the
view 64 % at most do (``data/real_static/rooms_110``, frames 79 to 89, structured light), of a
D435's 40 %."""
MIN_ON_SURFACE = 0.78
"""Fraction of the pixels with depth that must lie on it. Most of them, beside holes and
edges that were filled otherwise."""
OFF_SURFACE_PX = 0.5
"""Distance between the flow and that of the surface, px, below which a pixel moves with it."""
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
