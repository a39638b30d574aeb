"""One pair of a sequence as an estimate sees it, drawn: the paper's figures.

Input flow, ego flow and object flow, the error of the estimated motion, the weights of the
refinement and, for each network, uncertainty, error and saliency maps (paper, figures 1, 4, 5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

STEPS = 32
"""Of the integrated gradients."""


@dataclass(frozen=True, slots=True)
class PictureOptions:
    """What to draw and where to; exactly one of ``out`` and ``into`` is given.

    Args:
        sequence: folder of the sequence.
        pair: its first frame.
        dataset: kind of the sequence; None: detected.
        flow: ``auto``, ``file`` or ``dis``.
        method: estimate that is looked at; None: that of ``hybridvo run``.
        weights: networks to look through; empty: the shipped ones.
        steps: of the integrated gradients.
        seed: of the estimate.
        out: picture to write, .png.
        into: folder of a comparison, whose report gets the picture.
        overwrite: replace what is there.
        name: what the sequence is called; None: as its folder.
    """

    sequence: str
    pair: int
    dataset: str | None = None
    flow: str = "auto"
    method: str | None = None
    weights: tuple[Path, ...] = ()
    steps: int = STEPS
    seed: int = 0
    out: Path | None = None
    into: Path | None = None
    overwrite: bool = False
    name: str | None = None


def visualize(options: PictureOptions, command: list[str]) -> list[Path]:
    """Draw the maps of one pair.

    Args:
        options: what to draw and where to.
        command: written beside the picture.

    Returns:
        the files written: picture, numbers, and those of the report if ``options.into`` is given.

    Raises:
        InputError: unknown sequence, pair, weights, or a target that exists or is no PNG.
        OutputError: the target cannot be written.
    """
    from hybridvo.checks import make_folder
    from hybridvo.errors import InputError
    from hybridvo.evaluation.plots_maps import maps_png
    from hybridvo.evaluation.report import write_json
    from hybridvo.files import atomic_write
    from hybridvo.pipeline import DEFAULT_METHOD, estimate

    if options.steps < 1:
        raise InputError(f"--steps: expected at least 1, got {options.steps}.")
    method = options.method or DEFAULT_METHOD
    picture = target(options)
    pair, sequence, T_true, flow_true = read_pair(options)
    motion = estimate(pair, method=method, seed=options.seed)
    panels, numbers, moving = parts(pair, motion, T_true, flow_true)
    for name, network in networks(options.weights):
        more, values = look_through(name, network, pair, T_true, moving, options.steps)
        panels += more
        numbers |= values
    source = f"{pair.flow_source} (true)" if pair.flow_is_true else pair.flow_source
    called = options.name or sequence.name
    heading = f"{called}, pair {options.pair}; flow: {source}; motion: {method}, {motion.status}"
    height, width = pair.prev.camera.shape
    content = maps_png(panels, heading, width / height)
    make_folder(picture.parent)
    with atomic_write(picture, "wb") as file:
        file.write(content)
    record = {
        "title": f"{called}, pair {options.pair}",
        "caption": f"Flow: {source}; motion: {method}, {motion.status}.",
        "command": command,
        "numbers": [
            {"label": k, "value": "-" if v is None else f"{v:.4g}"} for k, v in numbers.items()
        ],
        "values": numbers,
        "picture": f"figures/{picture.name}" if options.into else picture.name,
    }
    write_json(picture.with_suffix(".json"), record)
    written = [picture, picture.with_suffix(".json")]
    if options.into:
        from hybridvo.evaluation.report_page import write_report

        written += write_report(options.into)
    return written


def target(options: PictureOptions) -> Path:
    """Picture to write."""
    from hybridvo.errors import InputError
    from hybridvo.evaluation.report_data import plain_stem

    if options.into is not None:
        if not (options.into / "results.json").is_file():
            raise InputError(
                f"--into {options.into}: holds no results.json; expected the output folder of "
                f"tools/compare_methods.py."
            )
        name = plain_stem(options.name or Path(options.sequence).name)
        path = options.into / "figures" / f"{name}_{options.pair:06d}.png"
    elif options.out is not None:
        path = options.out
    else:
        raise InputError("PictureOptions: one of out and into is needed, got neither.")
    if path.suffix.lower() != ".png":
        raise InputError(f"--out {path}: expected a name that ends in .png.")
    if path.exists() and not options.overwrite:
        raise InputError(f"{path}: exists; pass --overwrite.")
    return path


def read_pair(options: PictureOptions) -> tuple[Any, Any, np.ndarray | None, np.ndarray | None]:
    """(pair, sequence, true T_curr_prev or None, true flow or None)."""
    from hybridvo.configuration import RunOptions
    from hybridvo.data.sequence import iter_pairs, open_sequence
    from hybridvo.errors import InputError
    from hybridvo.geometry import invert
    from hybridvo.run import flow_provider

    sequence = open_sequence(options.sequence, options.dataset)
    if not 0 <= options.pair < len(sequence) - 1:
        raise InputError(
            f"--pair: {sequence.name} has pairs 0 to {len(sequence) - 2}, got {options.pair}."
        )
    run = RunOptions(flow=options.flow, start=options.pair, stop=options.pair + 2)
    provider = flow_provider(sequence, run)
    walk = iter_pairs(sequence, provider, start=options.pair, stop=options.pair + 2, stride=1)
    pair = next(iter(walk))
    if pair.flow is None or pair.prev.depth is None:
        missing = "flow" if pair.flow is None else "depth"
        raise InputError(f"{sequence.name}, pair {options.pair}: there is no {missing} to look at.")
    T_true = flow_true = None
    if sequence.poses is not None:
        T = invert(sequence.poses[options.pair + 1]) @ sequence.poses[options.pair]
        T_true = T if np.isfinite(T).all() else None
    if sequence.has_flow and sequence.flow_is_true:
        flow_true = pair.flow if pair.flow_is_true else sequence.flow(options.pair)[0]
    return pair, sequence, T_true, flow_true


def parts(
    pair: Any, motion: Any, T_true: np.ndarray | None, flow_true: np.ndarray | None
) -> tuple[list[Any], dict[str, float | None], np.ndarray]:
    """Panels and numbers that need no network, and (H, W) which pixels move by themselves."""
    from hybridvo.evaluation.maps import error_map, factor_flow, longest_flow, moving_pixels
    from hybridvo.evaluation.pairs import pair_errors
    from hybridvo.evaluation.plots_maps import FlowPanel, ImagePanel, ScalarPanel

    factored = factor_flow(pair, motion.T_curr_prev)
    truth_known = T_true is not None and flow_true is not None
    real = factored
    if T_true is not None and flow_true is not None:
        real = factor_flow(replace(pair, flow=flow_true), T_true)
    moving = moving_pixels(real.objects)
    whose = "true flow and motion" if truth_known else "this flow and the estimate"
    # one scale for all three: the parts are to be seen beside the whole
    longest = longest_flow(factored.total)
    panels: list[Any] = []
    if pair.prev.rgb is not None:
        panels.append(ImagePanel("previous image", pair.prev.rgb))
    panels += [
        FlowPanel("input flow F", factored.total, longest),
        FlowPanel("ego flow of the estimate", factored.ego, longest),
        FlowPanel("object flow, F minus ego flow", factored.objects, longest),
    ]
    numbers: dict[str, float | None] = {f"moving share, {whose}": float(moving.mean())}
    if T_true is not None:
        prev, curr, depth = pair.prev.camera, pair.curr.camera, pair.prev.depth
        error = error_map(motion.T_curr_prev, T_true, depth, prev, curr)
        panels.append(ScalarPanel("error of the ego flow", error, "px"))
        errors = pair_errors(motion.T_curr_prev, T_true, depth, prev, curr)
        numbers |= {
            "EPE, px": errors["epe_l2_px"],
            "rotation error, deg": errors["rot_err_deg"],
            "translation error, m": errors["trans_err"],
        }
    if motion.weights is not None:
        title = "weights of the motion (outline: what moves by itself)"
        panels.append(ScalarPanel(title, motion.weights, "", 1.0, moving))
    return panels, numbers, moving


def networks(files: Sequence[Path]) -> list[tuple[str, Any]]:
    """(name, network) of the given files, or of all shipped ones that predict a motion."""
    from hybridvo.errors import InputError
    from hybridvo.network.options import KINDS
    from hybridvo.network.weights import load_weights, pretrained, pretrained_names

    found = []
    for path in files or [pretrained(name) for name in pretrained_names()]:
        network: Any = load_weights(path)[0]
        kind = network.options.kind
        if kind in KINDS:
            found.append((path.stem, network))
        elif files:
            raise InputError(f"--weights {path}: expected {', '.join(KINDS)}, got a {kind}.")
    return found


def look_through(
    name: str,
    network: Any,
    pair: Any,
    T_true: np.ndarray | None,
    moving: np.ndarray,
    steps: int = STEPS,
) -> tuple[list[Any], dict[str, float | None]]:
    """Panels and numbers of one network: uncertainty, errors, saliency."""
    import torch

    from hybridvo.evaluation.maps import prediction_errors, share_on, uncertainty_maps
    from hybridvo.evaluation.plots_maps import ScalarPanel
    from hybridvo.geometry import matrix_to_euler_deg
    from hybridvo.network.inputs import assemble_inputs
    from hybridvo.types import PixelwisePrediction

    inputs = assemble_inputs(pair)
    T_start = start_of(network, inputs)
    with torch.no_grad():
        output = network(inputs, T_start)
    panels: list[Any] = []
    numbers: dict[str, float | None] = {}
    if isinstance(output, PixelwisePrediction):
        pairs = [("rotation", "deg"), ("translation", "m")]
        if output.log_scale_rotation is not None:
            for (what, unit), values in zip(pairs, uncertainty_maps(output), strict=True):
                title = f"{name}: uncertainty of the {what}"
                panels.append(ScalarPanel(title, values, unit, None, moving, True))
        if T_true is not None:
            true = matrix_to_euler_deg(T_true[:3, :3]), T_true[:3, 3]
            for (what, unit), values in zip(pairs, prediction_errors(output, *true), strict=True):
                panels.append(ScalarPanel(f"{name}: error of the {what}", values, unit))
    for what, saliency in saliencies(network, inputs, T_start, steps).items():
        relative = saliency.magnitude / max(float(np.percentile(saliency.magnitude, 99)), 1e-30)
        title = f"{name}: saliency of the {what}"
        panels.append(ScalarPanel(title, relative, "relative", 1.0, moving))
        numbers |= {
            f"{name}: saliency of the {what} on moving pixels": share_on(
                saliency.magnitude, moving
            ),
            f"{name}: part of the {what} that the saliency misses": saliency.completeness_error,
        }
    return panels, numbers


def start_of(network: Any, inputs: Any) -> Any:
    """Motion that a network of several passes starts its last one from; None for one pass."""
    from hybridvo.learned import next_start
    from hybridvo.network.passes import first_motions

    passes = int(network.options.passes)
    return first_motions(network, inputs, next_start(network), passes - 1)


def saliencies(
    network: Any, inputs: Any, T_start: Any = None, steps: int = STEPS
) -> dict[str, Any]:
    """Integrated gradients of rotation and translation over flow and inverse depth.

    The answer is the length of the predicted rotation (or translation) along its own direction. Of
    a pixel-wise network it is that of the pixels and weights that the selection chose for the real
    input: with the choice itself inside, the answer would jump along the path and nothing could be
    attributed. The path starts at zero flow and zero inverse depth, that is, nothing seen; for
    scale-free networks, which see the logarithm of the depth, at zero flow.
    """
    import torch

    from hybridvo.evaluation.maps import integrated_gradients
    from hybridvo.pose.selection import chosen_pose
    from hybridvo.types import PixelwisePrediction

    names = ("flow",) if network.options.scale_free else ("flow", "inverse_depth")
    given = tuple(getattr(inputs, name) for name in names)

    def run(*tensors: Any) -> Any:
        return network(replace(inputs, **dict(zip(names, tensors, strict=True))), T_start)

    with torch.no_grad():
        output = run(*given)
    found = {}
    for k, what in enumerate(("rotation", "translation")):
        if isinstance(output, PixelwisePrediction):
            maps = {name: getattr(output, name) for name in ("rotation", "translation")}
            maps = {name: value.clone().requires_grad_() for name, value in maps.items()}
            motion = chosen_pose(replace(output, **maps))[k]
            direction = (motion / motion.norm().clamp(min=1e-12)).detach()
            (weights,) = torch.autograd.grad((direction * motion).sum(), maps[what])

            answer = weighted_map(run, what, weights)
        else:
            motion = output[k]
            answer = along(run, k, motion / motion.norm().clamp(min=1e-12))
        found[what] = integrated_gradients(answer, given, steps=steps)
    return found


def weighted_map(run: Callable[..., Any], name: str, weights: Any) -> Callable[..., Any]:
    """Sum of a pixel-wise map under fixed weights, as a function of the inputs."""
    return lambda *tensors: (weights * getattr(run(*tensors), name)).sum()


def along(run: Callable[..., Any], part: int, direction: Any) -> Callable[..., Any]:
    """Length of one part of a motion along a fixed direction, as a function of the inputs."""
    return lambda *tensors: (direction * run(*tensors)[part]).sum()
