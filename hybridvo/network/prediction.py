"""What the methods take from a network for one pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.options import Options
from hybridvo.core.results import (
    Motion,
    MotionPrior,
    PixelwisePrediction,
    Reason,
    Status,
    Term,
)
from hybridvo.core.types import FramePair
from hybridvo.hypotheses.select import ChoiceEvidence
from hybridvo.network.euler import euler_transform
from hybridvo.network.hypothesis_maps import HypothesisNetwork
from hybridvo.network.pair_maps import look_at_pair
from hybridvo.network.selection import select_pose
from hybridvo.network.threads import single_threaded_inference

# degrees of uncertainty above which an answer is degraded: more than most cameras
# turn between two frames
MAX_NETWORK_SCALE_DEG = 2.0
# uncertainty of a network that states none: a usual motion
UNSTATED_ROTATION_DEG = 1.0
UNSTATED_TRANSLATION_M = 0.3

# numerical guard, degrees and metres: half precision resolves no smaller uncertainty
MIN_SCALE = 1e-4


def estimate_by_pwvo(
    pair: FramePair,
    network: HypothesisNetwork,
    prior: MotionPrior | None,
    options: Options,
    seed: int,
) -> Motion:
    """Estimate the camera motion of a pair by PWVO alone, without a refinement.

    Args:
        pair: frames with flow, and depth of the previous one.
        network: PWVO.
        prior: the expected motion, or None.
        options: the option tree.
        seed: of the search.

    Returns:
        The selected pose, with the covariance 2 U^2 of the Laplace scales U.

    Raises:
        StageFailed: if flow, depth or usable pixels are missing.
    """
    with single_threaded_inference():
        maps = look_at_pair(network, pair, prior, options, seed).prediction
    assert maps.evidence is not None
    evidence = ChoiceEvidence(*maps.evidence[0].tolist())
    return selected_motion(maps, "softmax").replace(evidence=evidence)


def selected_motion(maps: PixelwisePrediction, selection: str) -> Motion:
    """The selected motion of the maps of one pair, with the scales selected as it is."""
    pose = select_pose(maps, selection).double()
    T = euler_transform(pose)[0].cpu().numpy()
    scales = _selected_scales(maps, selection)
    rotation_deg = scales[:3]
    translation_m = scales[3:]
    variance = 2 * np.concatenate([translation_m, np.deg2rad(rotation_deg)]) ** 2
    return Motion(
        T_curr_prev=T,
        covariance=np.diag(variance),
        status=_network_status(float(rotation_deg.max())),
        terms=(Term.FLOW, Term.DEPTH),
    )


def _selected_scales(maps: PixelwisePrediction, selection: str) -> np.ndarray:
    """(6,) Laplace scales of the selected motion of one pair, degrees, then metres.

    The scales are selected as the motion is: same pixels, same weights.
    """
    if maps.log_scale is None:
        rotation_deg = np.full(3, UNSTATED_ROTATION_DEG)
        translation_m = np.full(3, UNSTATED_TRANSLATION_M)
        return np.concatenate([rotation_deg, translation_m])
    scales = replace(maps, motion=maps.log_scale.exp())
    selected = select_pose(scales, selection)[0].double().cpu().numpy()
    return np.maximum(selected, MIN_SCALE)


def _network_status(rotation_scale_deg: float) -> Status:
    """Degraded where the predicted uncertainty is larger than most motions."""
    if rotation_scale_deg <= MAX_NETWORK_SCALE_DEG:
        return Status()
    return Status.degraded(
        Reason.LOW_INLIERS,
        f"the network is uncertain by {rotation_scale_deg:.1f} degrees",
    )
