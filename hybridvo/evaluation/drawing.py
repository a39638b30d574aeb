"""Images of one pair: its flow and weights, the paper's figures, what networks look at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from hybridvo.api import estimate
from hybridvo.data.sequence import Sequence, iter_pairs
from hybridvo.errors import InputError
from hybridvo.evaluation.plots import Panel, flow_panel, longest_flow, write_panels
from hybridvo.evaluation.scores import MOVING_PX, true_motion
from hybridvo.files import make_folder
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, matrix_to_euler_deg
from hybridvo.network.inputs import assemble_inputs
from hybridvo.network.models import Models
from hybridvo.network.normalization import first_motions
from hybridvo.network.selection import select_pose
from hybridvo.pipeline import DEFAULT_METHOD
from hybridvo.results import PixelwisePrediction, RelativePose
from hybridvo.types import FramePair

PARTS = ("rotation", "translation")


def draw(
    sequence: Sequence,
    pair: int,
    out: str | Path,
    *,
    flow: str = "auto",
    method: str = DEFAULT_METHOD,
    models: Models | None = None,
    overwrite: bool = False,
) -> Path:
    """Draw the maps of one pair: flow and its parts, error, weights, and what PWVO looks at.

    ``pair`` is its first frame, ``out`` a .png; ``flow`` is ``auto`` (files where there are some),
    ``file`` or ``dis``.
    """
    out = Path(out)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: expected a name that ends in .png.")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; pass --overwrite.")
    if not 0 <= pair < len(sequence) - 1:
        raise InputError(f"--pair: {sequence.name} has pairs 0 to {len(sequence) - 2}, got {pair}.")
    from_files = flow == "file" or (flow == "auto" and sequence.has_flow)
    provider = None if from_files else dis_flow()
    given = next(iter_pairs(sequence, provider, start=pair, stop=pair + 2))
    if given.flow is None or given.prev.depth is None:
        raise InputError(f"{sequence.name}, pair {pair}: has no flow or no depth to look at.")
    models = models or Models()
    network: Any = models.network("pwvo")
    flow_gt = None
    if sequence.has_flow and sequence.flow_is_true:
        flow_gt = given.flow if given.flow_is_true else sequence.flow(pair)[0]
    T_gt = true_motion(sequence, pair, pair + 1)
    motion = estimate(given, method=method, models=models)
    panels, moving = _pair_panels(given, motion, T_gt, flow_gt)
    true = None if T_gt is None else (matrix_to_euler_deg(T_gt[:3, :3]), T_gt[:3, 3])
    inputs = assemble_inputs(given)
    T_start = first_motions(network, inputs, "softmax", int(network.options.passes) - 1)
    with torch.no_grad():
        panels += prediction_panels("PWVO", network(inputs, T_start), true, moving)
    panels += saliency_panels("PWVO", saliencies(network, inputs, T_start), moving)
    source = f"{given.flow_source} (true)" if given.flow_is_true else given.flow_source
    heading = f"{sequence.name}, pair {pair}; flow: {source}; motion: {method}, {motion.status}"
    make_folder(out.parent)
    write_panels(out, panels, heading, given.prev.camera.width / given.prev.camera.height)
    return out


# -- panels ---------------------------------------------------------------------------------------


def _pair_panels(
    pair: FramePair, motion: RelativePose, T_gt: np.ndarray | None, flow_gt: np.ndarray | None
) -> tuple[list[Panel], np.ndarray]:
    """Panels that need no network, and (H, W) which pixels move by themselves."""
    flow, depth = np.asarray(pair.flow), np.asarray(pair.prev.depth)
    cameras = pair.prev.camera, pair.curr.camera
    ego = ego_flow(depth, motion.T_curr_prev, *cameras)
    ego_gt = None if T_gt is None else ego_flow(depth, T_gt, *cameras)
    objects = flow - ego if ego_gt is None or flow_gt is None else flow_gt - ego_gt
    with np.errstate(invalid="ignore"):
        moving = np.linalg.norm(objects, axis=2) > MOVING_PX
    # one scale for all three: the parts are to be seen beside the whole
    longest = longest_flow(flow)
    panels = [] if pair.prev.rgb is None else [Panel("previous image", pair.prev.rgb)]
    parts = {"flow F": flow, "ego flow": ego, "F minus ego flow": flow - ego}
    panels += [flow_panel(title, part, longest) for title, part in parts.items()]
    if ego_gt is not None:
        panels.append(Panel("error of the ego flow", np.linalg.norm(ego - ego_gt, axis=2), "px"))
    if motion.weights is not None:
        panels.append(Panel("weights (outline: moving)", motion.weights, "weight", 1.0, moving))
    return panels, moving


def prediction_panels(
    name: str,
    prediction: PixelwisePrediction,
    true: tuple[np.ndarray, np.ndarray] | None,
    moving: np.ndarray,
) -> list[Panel]:
    """The paper's maps of the first pair of a prediction: uncertainty, and errors where known.

    The geometric mean of the three scales U, and the mean absolute difference from the ``true``
    Euler angles X-Y-Z, degrees, and translation, metres. ``moving`` (H, W) is outlined.
    """
    panels = []
    for k, (what, unit) in enumerate((("rotation", "deg"), ("translation", "m"))):
        scale = getattr(prediction, f"log_scale_{what}")
        if scale is not None:  # beside its own scale: the paper compares where they are large
            U = scale[0].detach().float().mean(0).exp().cpu().numpy()
            panels.append(
                Panel(f"{name}: uncertainty of the {what}", U, f"{unit}, U", None, moving)
            )
        if true is not None:
            found = getattr(prediction, what)[0].detach().cpu().double().numpy()
            error = np.abs(found - np.reshape(true[k], (3, 1, 1))).mean(axis=0)
            panels.append(Panel(f"{name}: error of the {what}", error, unit, None, moving))
    return panels


def saliency_panels(name: str, found: Mapping[str, np.ndarray], moving: np.ndarray) -> list[Panel]:
    """Where a network looks; what moves is outlined."""
    panels = []
    for what, magnitude in found.items():
        shown = cv2.blur(magnitude, (4, 4))  # networks read one of some pixels only
        relative = shown / max(float(np.percentile(shown, 99)), 1e-30)
        panels.append(Panel(f"{name}: saliency, {what}", relative, "relative", 1.0, moving))
    return panels


# -- what a network looks at -----------------------------------------------------------------------


def integrated_gradients(
    answer: Callable[..., torch.Tensor], inputs: tuple[torch.Tensor, ...], steps: int = 32
) -> list[torch.Tensor]:
    """Attributions of a scalar answer, like its inputs (Sundararajan, Taly and Yan, ICML 2017).

    Their sum is the answer for the inputs minus that for zeros, but for the error of the integral:
    32 ``steps`` leave less than a percent.
    """
    nodes, weights = np.polynomial.legendre.leggauss(steps)
    sums = [torch.zeros_like(x) for x in inputs]
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        points = [(float(node) * x).detach().requires_grad_() for x in inputs]
        # an input that the answer does not depend on has no gradient
        gradients = torch.autograd.grad(answer(*points), points, allow_unused=True)
        for total, gradient in zip(sums, gradients, strict=True):
            if gradient is not None:
                total += float(weight) * gradient
    return [total * x for total, x in zip(sums, inputs, strict=True)]


def saliencies(
    network: Any, inputs: Any, T_start: Any = None, steps: int = 32
) -> dict[str, np.ndarray]:
    """Absolute attributions (h, w) of rotation and translation to flow and inverse depth.

    The answer is the length of the predicted rotation (or translation) along its own direction,
    with the pixels and weights chosen for the real input. The path starts at zero; the depth of
    scale-free networks is held fixed, as is what earlier passes found.
    """
    names = ("flow",) if network.options.scale_free else ("flow", "inverse_depth")
    given = tuple(getattr(inputs, name) for name in names)

    def run(*tensors: torch.Tensor) -> Any:
        return network(replace(inputs, **dict(zip(names, tensors, strict=True))), T_start)

    def part(output: Any, k: int) -> torch.Tensor:
        is_map = isinstance(output, PixelwisePrediction)
        return getattr(output, PARTS[k]) if is_map else output[k]

    with torch.no_grad():
        output = run(*given)
    found = {}
    for k, what in enumerate(PARTS):
        motion = weights = part(output, k).clone().requires_grad_()
        if isinstance(output, PixelwisePrediction):
            own: dict[str, Any] = {what: weights}
            motion = select_pose(replace(output, **own))[k]
        direction = (motion / motion.norm().clamp(min=1e-12)).detach()
        (weights,) = torch.autograd.grad((direction * motion).sum(), weights)
        answer = lambda *x, k=k, w=weights: (w * part(run(*x), k)).sum()  # noqa: E731
        attributions = integrated_gradients(answer, given, steps)
        found[what] = torch.cat(attributions, dim=1)[0].abs().sum(0).cpu().numpy()
    return found
