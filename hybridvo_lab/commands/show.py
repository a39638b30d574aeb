"""``hybridvo show``: the maps of one pair, and what PWVO looks at in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from hybridvo.api import estimate
from hybridvo.core.errors import InputError
from hybridvo.core.files import make_folder
from hybridvo.core.geometry import matrix_to_euler_deg
from hybridvo.core.options import NETWORK
from hybridvo.core.results import PixelwisePrediction, StageFailed
from hybridvo.core.types import FramePair
from hybridvo.flow.providers import FlowProvider, dis_flow
from hybridvo.io.data.open import iter_pairs
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.truth import true_motion
from hybridvo.io.onnx.flow import FlowNetwork
from hybridvo.network.models import Models
from hybridvo.network.pair_maps import look_at_pair
from hybridvo.pipeline import DEFAULT_METHOD
from hybridvo_lab.visualization.pair import (
    TrueMotion,
    moving_pixels,
    pair_panels,
    prediction_panels,
)
from hybridvo_lab.visualization.panels import Panel, write_panels
from hybridvo_lab.visualization.saliency import saliencies, saliency_panels

COLUMNS = 3
PANEL_INCHES = 4.4


def draw_pair(
    sequence: Sequence,
    pair: int,
    out: str | Path,
    *,
    flow: str = "auto",
    method: str = DEFAULT_METHOD,
    models: Models | None = None,
    everything: bool = False,
    overwrite: bool = False,
) -> Path:
    """Draw a pair as a PNG: image, depth, flow, what the motion leaves of it, weights.

    Args:
        sequence: The sequence.
        pair: Index of the first frame of the pair.
        out: The file.
        flow: ``auto``, ``file``, ``dis``, or ``onnx:FILE``: a network.
        method: The estimator of the motion.
        models: The networks; by default the pretrained ones.
        everything: Whether the other image, the ego flow and its error, PWVO's maps and what it
            looks at are drawn as well.
        overwrite: Whether an existing file is replaced.

    Returns:
        The file.

    Raises:
        InputError: The sequence has no such pair, or the pair has no flow or no depth.
        OutputError: The file cannot be written.
    """
    out = Path(out)
    _check_arguments(sequence, pair, out, overwrite)
    models = models or Models()
    given = _read_pair(sequence, pair, flow)
    T_gt = true_motion(sequence, pair, pair + 1)
    has_true_flow = sequence.has_flow and sequence.flow_is_true
    flow_gt = sequence.flow(pair)[0] if has_true_flow else None
    motion = estimate(given, method=method, models=models)
    moving = moving_pixels(given, motion, T_gt, flow_gt)
    panels = pair_panels(given, motion, T_gt, moving, everything)
    if everything:
        panels += _network_panels(given, models, T_gt, moving)
    source = given.flow_source
    if given.flow_is_true:
        source += " (true)"
    frames = f"frames {pair} and {pair + 1}"
    heading = f"{sequence.name}, {frames}; flow: {source}; motion: {method}, {motion.status}"
    aspect = given.prev.camera.width / given.prev.camera.height
    make_folder(out.parent)
    write_panels(out, panels, heading, aspect, columns=COLUMNS, inches=PANEL_INCHES)
    return out


def _check_arguments(
    sequence: Sequence, pair: int, out: Path, overwrite: bool
) -> None:
    """Refuse a file that cannot be written, and a pair that is not there."""
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: expected a name that ends in .png.")
    if out.exists() and not overwrite:
        raise InputError(
            f"{out}: exists; pass another name as --out, or --overwrite."
        )
    if not 0 <= pair < len(sequence) - 1:
        raise InputError(
            f"--pair: {sequence.name} has pairs 0 to {len(sequence) - 2}, got {pair}."
        )


def _read_pair(sequence: Sequence, pair: int, flow: str) -> FramePair:
    """Read a pair with its flow, from files or by DIS."""
    from_files = flow == "file" or (flow == "auto" and sequence.has_flow)
    provider: FlowProvider | None = None
    if flow.startswith(NETWORK):
        provider = FlowNetwork(flow)
    elif not from_files:
        provider = dis_flow()
    given = next(iter_pairs(sequence, provider, start=pair, stop=pair + 2))
    if given.flow is None or given.prev.depth is None:
        raise InputError(
            f"{sequence.name}, pair {pair}: has no flow or no depth to look at."
        )
    return given


def _network_panels(
    given: FramePair, models: Models, T_gt: Any, moving: Any
) -> list[Panel]:
    """Make the panels of what PWVO predicts for a pair, and of what it looks at."""
    network = models.network("pwvo")
    try:
        look = look_at_pair(network, given)
    except StageFailed:
        return []
    truth = None
    if T_gt is not None:
        truth = TrueMotion(matrix_to_euler_deg(T_gt[:3, :3]), T_gt[:3, 3])
    usable = look.inputs.usable[0].cpu().numpy()
    panels = prediction_panels(look.prediction, truth, moving, usable)

    def predict(flow: torch.Tensor) -> PixelwisePrediction:
        maps = network.maps(network.look(look.inputs.with_flow(flow)))
        return PixelwisePrediction(maps.motion, maps.log_scale)

    maps = saliencies(predict, (look.inputs.flow,))
    return panels + saliency_panels("PWVO", maps, moving)
