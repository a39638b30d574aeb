"""Drawing trajectories, and the maps of a pair with the paper's; no global state is touched."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize, hsv_to_rgb
from matplotlib.figure import Figure

from hybridvo.api import estimate
from hybridvo.data.open import iter_pairs
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.metrics import PathError, aligned
from hybridvo.evaluation.scores import MOVING_PX, true_motion
from hybridvo.files import atomic_write, make_folder
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, invert, matrix_to_euler_deg
from hybridvo.network.inputs import assemble_inputs
from hybridvo.network.models import Models
from hybridvo.network.prediction import first_motions
from hybridvo.network.selection import select_pose
from hybridvo.pipeline import DEFAULT_METHOD
from hybridvo.results import PixelwisePrediction, RelativePose
from hybridvo.trajectory import Trajectory
from hybridvo.types import FramePair

# colours that people with any kind of sight tell apart (Okabe and Ito)
_BLUE = "#0072B2"
_BLACK = "#222222"
_ORANGE = "#E69F00"
_RED = "#D55E00"
PARTS = ("rotation", "translation")
DISTRUSTED = 0.5
"""Weight of a pixel below which the estimate does not rest on it."""
BEYOND_NOISE = 3.0
"""Standard deviations of the flow beyond which a difference is no noise."""
SEEN_GREY = 3.0
"""Grey levels by which a region has to fit its flow better than the camera's motion."""
SMALLEST_REGION = 0.01
"""Share of the image that a body has to fill to be outlined."""


def plot_trajectory(
    name: str,
    est: Trajectory,
    path: str | Path,
    *,
    truth: Trajectory | None = None,
    title: str = "",
    states: Iterable[str] | None = None,
) -> None:
    """Draw a trajectory from above as a PNG; the arguments are those of `trajectory_figure`."""
    figure = trajectory_figure(name, est, truth=truth, title=title, states=states)
    # of the font
    with warnings.catch_warnings(action="ignore"), atomic_write(path, "wb") as file:
        figure.savefig(file, format="png")


def trajectory_figure(
    name: str,
    est: Trajectory,
    *,
    truth: Trajectory | None = None,
    title: str = "",
    states: Iterable[str] | None = None,
) -> Figure:
    """Draw a trajectory from above, aligned to the truth and above its error over time.

    Args:
        name: Of the method, for the legend.
        est: The trajectory.
        truth: The true one, if it is known.
        title: Stands above.
        states: The state of the motion to each pose (``ok``, ``degraded``, ``failed``): where it
            is not ok, the pose is marked.
    """
    figure = Figure(figsize=(10.0, 7.4), dpi=130, layout="constrained")
    heights = [1.0] if truth is None else [2.0, 1.0]
    above, *below = figure.subplots(
        len(heights), squeeze=False, height_ratios=heights
    )[:, 0]
    above.set(xlabel="x right [m]", ylabel="z forward [m]")
    style: dict[str, Any] = {"color": _BLUE, "linewidth": 1.4}
    if truth is not None:
        bold = {
            "label": "ground truth",
            "color": _BLACK,
            "linewidth": 2.6,
            "alpha": 0.55,
        }
        above.plot(*_from_above(truth, truth), **bold)
        below[0].set(xlabel="time [s]", ylabel="position error [cm]")
        est, error, kind = aligned(est, truth)
        if error is not None:
            since = error.stamps - truth.timestamps[0]
            below[0].plot(since, 100 * error.translation, **style)
            name = f"{name} ({_ate_in_words(error, kind)})"
    x, z = _from_above(est, truth or est)
    above.plot(x, z, label=name, **style)
    _mark_poses(above, x, z, [] if states is None else list(states))
    # a camera that does not move
    above.update_datalim([[-5e-4, -5e-4], [5e-4, 5e-4]])
    above.set_aspect("equal", adjustable="datalim")
    above.autoscale_view()
    for axes in (above, *below):
        axes.grid(True, color="#e4e4e4", linewidth=0.8)
    figure.legend(loc="outside lower center", frameon=False, fontsize=9, ncols=3)
    figure.suptitle(
        title.encode("utf-8", "replace").decode(), fontsize=11, parse_math=False
    )
    return figure


def _ate_in_words(error: PathError, kind: str) -> str:
    """The error of an aligned path; no number where only the first poses could be aligned."""
    if kind == "origin":
        return (
            "ATE -: not enough poses, or all on a line; drawn from the first pose"
        )
    return f"ATE {100 * error.rmse:.3g} cm, {kind}"


def _mark_poses(axes: Any, x: np.ndarray, z: np.ndarray, states: list[str]) -> None:
    """Mark the start, the end, and the poses whose motion is not ok."""
    start = {"marker": "o", "color": _BLACK, "markersize": 5}
    end = {"marker": "s", "color": _BLUE, "markersize": 7}
    axes.plot(x[:1], z[:1], linestyle="none", label="start", zorder=5, **start)
    axes.plot(x[-1:], z[-1:], linestyle="none", label="end", zorder=5, **end)
    for state, colour, marker in (
        ("degraded", _ORANGE, "D"),
        ("failed", _RED, "X"),
    ):
        at = [k for k, found in enumerate(states) if found == state]
        if at:
            label = f"{state} ({len(at)})"
            look = {"marker": marker, "color": colour, "markersize": 6, "zorder": 6}
            axes.plot(x[at], z[at], linestyle="none", label=label, **look)


def _from_above(path: Trajectory, first: Trajectory) -> np.ndarray:
    """The x and z (2, N) of a path in the first camera of another one."""
    return path.transformed(invert(first.T_world_cam[0])).positions[:, [0, 2]].T


# -- one pair -------------------------------------------------------------------------------------


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
    """Draw a pair as a PNG: images, depth, flow and its parts, error, weights, what PWVO looks at.

    ``pair`` is the index of its first frame; ``flow`` is ``auto``, ``file`` or ``dis``.
    """
    out = Path(out)
    if out.suffix.lower() != ".png":
        raise InputError(f"{out}: expected a name that ends in .png.")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; pass --overwrite.")
    if not 0 <= pair < len(sequence) - 1:
        raise InputError(
            f"--pair: {sequence.name} has pairs 0 to {len(sequence) - 2}, got {pair}."
        )
    from_files = flow == "file" or (flow == "auto" and sequence.has_flow)
    provider = None if from_files else dis_flow()
    given = next(iter_pairs(sequence, provider, start=pair, stop=pair + 2))
    if given.flow is None or given.prev.depth is None:
        raise InputError(
            f"{sequence.name}, pair {pair}: has no flow or no depth to look at."
        )
    models = models or Models()
    network: Any = models.network("pwvo")
    flow_gt = (
        sequence.flow(pair)[0]
        if sequence.has_flow and sequence.flow_is_true
        else None
    )
    T_gt = true_motion(sequence, pair, pair + 1)
    motion = estimate(given, method=method, models=models)
    panels, moving = pair_panels(given, motion, T_gt, flow_gt)
    true = (
        None if T_gt is None else (matrix_to_euler_deg(T_gt[:3, :3]), T_gt[:3, 3])
    )
    inputs = assemble_inputs(given)
    T_start, _ = first_motions(
        network, inputs, "softmax", int(network.options.passes) - 1
    )
    with torch.no_grad():
        maps = network(inputs, T_start)
    known = (
        inputs.on_grid_of(maps.motion)
        .valid[0]
        .reshape(maps.motion.shape[-2:])
        .cpu()
        .numpy()
    )
    panels += prediction_panels(maps, true, moving, known)
    panels += saliency_panels("PWVO", saliencies(network, inputs, T_start), moving)
    source = (
        f"{given.flow_source} (true)" if given.flow_is_true else given.flow_source
    )
    heading = f"{sequence.name}, pair {pair}; flow: {source}; motion: {method}, {motion.status}"
    make_folder(out.parent)
    aspect = given.prev.camera.width / given.prev.camera.height
    write_panels(out, panels, heading, aspect, columns=3, inches=4.4)
    return out


def pair_panels(
    pair: FramePair,
    motion: RelativePose,
    T_gt: np.ndarray | None,
    flow_gt: np.ndarray | None,
) -> tuple[list[Panel], np.ndarray]:
    """Make the panels that need no network; returns which pixels move by themselves (H, W) too.

    What moves is taken from the true motion and flow where both are known. Else it is where the
    flow differs from the estimated ego flow beyond its own noise, the estimate rests on none of
    it, and the images agree with the flow: where they are smooth, flow is often wrong by pixels.
    """
    flow = np.asarray(pair.flow)
    depth = np.asarray(pair.prev.depth)
    cameras = pair.prev.camera, pair.curr.camera
    ego = ego_flow(depth, motion.T_curr_prev, *cameras)
    ego_gt = None if T_gt is None else ego_flow(depth, T_gt, *cameras)
    is_known = False
    objects = flow - ego
    if ego_gt is not None and flow_gt is not None:
        is_known = True
        objects = flow_gt - ego_gt
    limit = np.full(depth.shape, MOVING_PX)
    if not is_known and pair.flow_variance is not None:
        limit = np.maximum(limit, BEYOND_NOISE * np.sqrt(pair.flow_variance))
    with np.errstate(invalid="ignore"):
        moving = np.linalg.norm(objects, axis=2) > limit
    if not is_known and motion.weights is not None:
        size = moving.shape[::-1]
        weights = cv2.resize(motion.weights, size, interpolation=cv2.INTER_NEAREST)
        moving &= weights < DISTRUSTED
    moving = coherent(moving)
    if not is_known:
        moving = _seen_to_move(moving, pair, ego)
    images = {"previous image": pair.prev.rgb, "current image": pair.curr.rgb}
    panels = [Panel(title, rgb) for title, rgb in images.items() if rgb is not None]
    known = np.where(depth > 0, depth, np.nan)
    panels.append(Panel("depth", known, "m", _high(known)))
    longest = longest_flow(flow)  # one scale for the flow and its two parts
    parts = {"flow F": flow, "ego flow": ego, "F minus ego flow": flow - ego}
    panels += [flow_panel(title, part, longest) for title, part in parts.items()]
    if ego_gt is not None:
        panels.append(
            Panel(
                "error of the ego flow", np.linalg.norm(ego - ego_gt, axis=2), "px"
            )
        )
    if motion.weights is not None:
        title = "weights (outline: moving)" if moving.any() else "weights"
        panels.append(Panel(title, motion.weights, "0 to 1", 1.0, moving))
    return panels, moving


def _seen_to_move(
    regions: np.ndarray, pair: FramePair, ego: np.ndarray
) -> np.ndarray:
    """Keep the regions (H, W) bool whose image fits the flow clearly better than the ego flow."""
    if pair.prev.rgb is None or pair.curr.rgb is None:
        return regions
    prev, curr = (
        cv2.blur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (5, 5))
        for rgb in (pair.prev.rgb, pair.curr.rgb)
    )
    v, u = np.indices(prev.shape, dtype=np.float32)

    def difference(flow: np.ndarray) -> np.ndarray:
        """Grey levels between the previous image and the current one warped onto it."""
        known = np.nan_to_num(flow.astype(np.float32), nan=-1e6)
        x = u + known[..., 0]
        y = v + known[..., 1]
        return np.abs(cv2.remap(curr, x, y, cv2.INTER_LINEAR) - prev)

    by_flow = difference(np.asarray(pair.flow))
    by_ego = difference(ego)
    count, labels = cv2.connectedComponents(regions.astype(np.uint8))
    kept = [
        label
        for label in range(1, count)
        if np.median(by_ego[labels == label])
        > SEEN_GREY + np.median(by_flow[labels == label])
    ]
    return np.isin(labels, kept)


def coherent(mask: np.ndarray) -> np.ndarray:
    """Keep the regions of a mask (H, W) bool that a body can fill: neither specks nor thin lines.

    A region has at least one percent of the image, after what is thinner than two percent of its
    width has been taken away.
    """
    height, width = mask.shape
    thick = 2 * max(1, round(width / 100)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (thick, thick))
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(opened)
    large = sizes[:, cv2.CC_STAT_AREA] >= SMALLEST_REGION * height * width
    large[0] = False  # what is not in the mask
    return large[labels]


def prediction_panels(
    prediction: PixelwisePrediction,
    true: tuple[np.ndarray, np.ndarray] | None,
    moving: np.ndarray,
    known: np.ndarray | None = None,
) -> list[Panel]:
    """Make the paper's maps of the first pair of a batch: uncertainty, and error if truth is known.

    ``true`` holds Euler angles X-Y-Z, degrees, and translation, metres; ``moving`` (H, W) is
    outlined; pixels that are not ``known`` (h, w) have no uncertainty. A map is the geometric mean
    of U, or the mean absolute error, of three components.
    """
    panels = []
    for k, (what, unit) in enumerate(zip(PARTS, ("deg", "m"), strict=True)):
        half = slice(3 * k, 3 * k + 3)
        s = prediction.log_scale
        # beside its own scale: the paper compares where they are large
        if s is not None:
            U = s[0, half].detach().float().mean(0).exp().cpu().numpy()
            U = U if known is None else np.where(known, U, np.nan)
            title = f"PWVO: uncertainty of the {what}"
            panels.append(Panel(title, U, f"{unit}, U", outline=moving, log=True))
        if true is not None:
            found = prediction.motion[0, half].detach().cpu().double().numpy()
            error = np.abs(found - np.reshape(true[k], (3, 1, 1))).mean(axis=0)
            panels.append(
                Panel(f"PWVO: error of the {what}", error, unit, None, moving)
            )
    return panels


def saliency_panels(
    name: str, found: Mapping[str, np.ndarray], moving: np.ndarray
) -> list[Panel]:
    """Make the panels of :func:`saliencies`, with what moves outlined."""
    panels = []
    for what, magnitude in found.items():
        shown = cv2.blur(magnitude, (4, 4))  # networks read one of some pixels only
        title = f"{name}: saliency, {what}"
        panels.append(Panel(title, shown / _high(shown), "relative", 1.0, moving))
    return panels


# -- what a network looks at -----------------------------------------------------------------------


def integrated_gradients(
    answer: Callable[..., torch.Tensor],
    inputs: tuple[torch.Tensor, ...],
    steps: int = 32,
) -> list[torch.Tensor]:
    """Attribute a scalar answer to its inputs (Sundararajan, Taly and Yan, ICML 2017).

    The attributions sum to the answer for the inputs minus that for zeros, to a percent or less.
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
    """Return how much the flow and inverse depth of each pixel matter to the motion, maps (h, w).

    The maps are absolute attributions of the lengths of rotation and translation, with the pixels
    and weights selected for the real input. The depth of scale-free networks is held fixed, and so
    is ``T_start``, which earlier passes found.
    """
    names = ("flow",) if network.options.scale_free else ("flow", "inverse_depth")
    given = tuple(getattr(inputs, name) for name in names)

    def run(*tensors: torch.Tensor) -> PixelwisePrediction:
        return network(
            replace(inputs, **dict(zip(names, tensors, strict=True))), T_start
        )

    with torch.no_grad():
        output = run(*given)
    found = {}
    for k, what in enumerate(PARTS):
        maps = output.motion.clone().requires_grad_()
        motion = select_pose(replace(output, motion=maps))[:, 3 * k : 3 * k + 3]
        direction = (motion / motion.norm().clamp(min=1e-12)).detach()
        (weights,) = torch.autograd.grad((direction * motion).sum(), maps)
        answer = lambda *x, w=weights: (w * run(*x).motion).sum()  # noqa: E731
        attributions = integrated_gradients(answer, given, steps)
        found[what] = torch.cat(attributions, dim=1)[0].abs().sum(0).cpu().numpy()
    return found


@dataclass(frozen=True, eq=False)
class Panel:
    """One image of a figure, or a map with a colour bar, in which NaN is grey."""

    title: str
    values: np.ndarray  # (H, W, 3) uint8, or (h, w)
    unit: str = ""  # bars of one unit have the same ends, unless one is given
    high: float | None = None  # upper end of the bar; default: the 99th percentile
    outline: np.ndarray | None = None  # (H, W) bool, whose border is drawn
    log: bool = False  # a bar over decades, from the 1st percentile on


def flow_panel(title: str, flow: np.ndarray, longest: float) -> Panel:
    """Make a panel of a flow (H, W, 2), px, whose colours are full at ``longest``."""
    return Panel(
        f"{title} (full colour: {longest:.3g} px)", flow_colours(flow, longest)
    )


def write_panels(
    path: str | Path,
    panels: list[Panel],
    heading: str,
    aspect: float,
    *,
    columns: int = 2,
    inches: float = 5.4,
) -> None:
    """Write panels as a PNG, all with the same width over height.

    Args:
        path: The file.
        panels: From left to right, row by row.
        heading: Stands above all.
        aspect: Width over height of every panel.
        columns: Panels in a row.
        inches: Width of a panel with its bar.
    """
    # in inches, for an automatic layout leaves gaps between images of a fixed aspect
    bar = 0.11 * inches
    gap = 0.02 * inches
    title = 0.26
    wide = inches - bar - gap
    high = wide / aspect
    rows = -(-len(panels) // columns)
    top = 0.4 if heading else 0.0
    size = columns * inches, rows * (high + title + gap) + top
    figure = Figure(figsize=size)

    def place(left: float, upper: float, width: float) -> Any:
        """Axes of the panels' height, by their left upper corner."""
        corner = left / size[0], 1 - (upper + high) / size[1]
        return figure.add_axes((*corner, width / size[0], high / size[1]))

    ends = _ends_of_bars(panels)
    for k, panel in enumerate(panels):
        row, column = divmod(k, columns)
        left = column * inches + gap
        upper = top + row * (high + title + gap) + title
        axes = place(left, upper, wide)
        unit = f" [{panel.unit}]" if panel.unit else ""
        axes.set_title(
            panel.title + unit,
            fontsize=min(10, 2 + 1.5 * inches),
            loc="left",
            pad=3,
        )
        axes.set(xticks=[], yticks=[])
        drawn = _draw_panel(axes, panel, aspect, ends[k])
        if drawn is not None:
            beside = place(left + wide + gap / 2, upper, 0.02 * inches)
            shown = figure.colorbar(drawn, cax=beside)
            if panel.log:
                ticks = np.geomspace(*ends[k], 4).tolist()
                shown.set_ticks(
                    ticks, labels=[f"{tick:.2g}" for tick in ticks], minor=False
                )
                shown.minorticks_off()
            beside.tick_params(labelsize=min(7, 1.6 * inches), length=2, pad=1)
    figure.text(
        gap / size[0], 1 - 0.26 / size[1], heading, fontsize=11, parse_math=False
    )
    with atomic_write(path, "wb") as file:
        figure.savefig(file, format="png")


def _ends_of_bars(panels: list[Panel]) -> list[tuple[float, float]]:
    """The lower and upper end of every panel's colour bar."""
    own = []
    shared = dict[str, tuple[float, float]]()
    for panel in panels:
        is_map = panel.values.ndim == 2
        high = (
            _high(panel.values)
            if panel.high is None and is_map
            else panel.high or 1.0
        )
        low = min(_low(panel.values), 0.5 * high) if panel.log and is_map else 0.0
        own.append((low, high))
        if panel.high is None and is_map:
            before = shared.get(panel.unit, (low, high))
            shared[panel.unit] = min(low, before[0]), max(high, before[1])
    return [
        both if panel.high is not None else shared.get(panel.unit, both)
        for panel, both in zip(panels, own, strict=True)
    ]


def _draw_panel(
    axes: Any, panel: Panel, aspect: float, ends: tuple[float, float]
) -> Any:
    """Draw a panel; returns what its colour bar is for, None for an image."""
    shape: dict[str, Any] = {
        "extent": (0.0, aspect, 1.0, 0.0),
        "interpolation": "nearest",
    }
    if panel.values.ndim == 3:
        axes.imshow(panel.values, **shape)
        return None
    norm = (LogNorm if panel.log else Normalize)(*ends)
    colours = colormaps["magma"].with_extremes(bad="#9a9a9a")
    drawn = axes.imshow(panel.values, cmap=colours, norm=norm, **shape)
    if (
        panel.outline is not None
        and panel.outline.any()
        and not panel.outline.all()
    ):
        h, w = panel.outline.shape
        x = (np.arange(w) + 0.5) * aspect / w
        y = (np.arange(h) + 0.5) / h
        axes.contour(
            x, y, panel.outline, levels=[0.5], colors="#4fd1ff", linewidths=0.8
        )
    return drawn


def flow_colours(flow: np.ndarray, longest: float | None = None) -> np.ndarray:
    """Draw a flow (H, W, 2) as RGB (H, W, 3) uint8: hue is direction, saturation is length.

    ``longest`` px (default: the 99th percentile) is full colour, longer dark, unknown black.
    """
    known = np.isfinite(flow).all(axis=2)
    u, v = np.moveaxis(np.where(known[..., None], flow, 0.0), 2, 0)
    length = np.hypot(u, v) / (longest or longest_flow(flow))
    value = np.where(known, np.where(length > 1, 0.75, 1.0), 0.0)
    hsv = np.stack(
        [np.arctan2(v, u) / (2 * np.pi) % 1, np.minimum(length, 1), value], axis=-1
    )
    return (255 * hsv_to_rgb(hsv) + 0.5).astype(np.uint8)


def longest_flow(flow: np.ndarray) -> float:
    """Return the 99th percentile of the lengths of a flow (H, W, 2), px."""
    return _high(np.hypot(flow[..., 0], flow[..., 1]))


def _low(values: np.ndarray) -> float:
    """The 1st percentile of the known positive values; almost zero where there are none."""
    known = values[np.isfinite(values) & (values > 0)]
    return max(float(np.percentile(known, 1)), 1e-12) if known.size else 1e-12


def _high(values: np.ndarray) -> float:
    """The 99th percentile of the known values; almost zero where none is known."""
    known = values[np.isfinite(values)]
    return max(float(np.percentile(known, 99)), 1e-12) if known.size else 1e-12
