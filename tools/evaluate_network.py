"""What a network's weights can do, beyond their card: is its doubt honest, and one large mover.

    python tools/evaluate_network.py --out docs/results/network.json --overwrite

Writes the JSON and, beside it, a picture of the same name: reliability of the stated scales, and
the errors where one object covers 50 to 80 % of the picture.
"""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

LEVELS = np.linspace(0.05, 0.95, 19)
"""Nominal shares of errors below the quantile of a Laplace variable of that level."""
PIXEL_STRIDE = 2
COVERAGE = (0.5, 0.8)


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate_network.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--weights", default="pwvo", help="name of shipped weights, or a file")
    parser.add_argument("--count", type=int, default=300, help="held-out pairs of each part")
    parser.add_argument("--seed", type=int, default=5000, help="0-999 development, else published")
    parser.add_argument("--out", type=Path, default=Path("docs/results/network.json"))
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import HybridVOError
    from hybridvo.evaluation.report import write_json
    from hybridvo.network.weights import load_weights, pretrained

    if args.out.exists() and not args.overwrite:
        print(f"evaluate_network.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    if args.count < 1 or args.seed < 0:
        print("evaluate_network.py: expected --count >= 1 and --seed >= 0.", file=sys.stderr)
        return 2
    try:
        path = Path(args.weights) if Path(args.weights).is_file() else pretrained(args.weights)
        network, card = load_weights(path)
        result = {
            "command": "python tools/evaluate_network.py "
            + shlex.join(sys.argv[1:] if argv is None else argv),
            "weights": path.name,
            "card": card.get("held_out"),
            "seed": args.seed,
            "reliability": reliability(network, args.seed, args.count),
            "one_mover": one_mover(network, args.seed, args.count),
        }
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(args.out, result)
        draw(result, args.out.with_suffix(".png"))
    except HybridVOError as error:
        print(f"evaluate_network.py: {error}", file=sys.stderr)
        return error.exit_code if hasattr(error, "exit_code") else 2
    for name in ("rotation", "translation"):
        row = result["reliability"][name]
        print(f"{name}: mean |error| / U {row['mean_ratio']:.2f}, AUROC {row['auroc']:.3f}")
    for name, row in result["one_mover"]["methods"].items():
        print(f"{name}: median rotation error {row['median_deg']:.4f} deg")
    return 0


def reliability(network: Any, seed: int, count: int) -> dict[str, Any]:
    """Stated scales against errors over the pixels of held-out ``wide`` pairs.

    With error e and scale U of a component, e / U of a calibrated network is an exponential
    variable: mean 1, and a share p of the values below -ln(1 - p).
    """
    import torch
    import torch.nn.functional as F

    from hybridvo.learned import next_start
    from hybridvo.network.passes import predict
    from hybridvo.synthetic.diverse import DiverseOptions
    from hybridvo.training.stream import collate, sample_generator
    from hybridvo.training.validation import area_under_curve

    preset = DiverseOptions()
    ratios: dict[str, list[np.ndarray]] = {"rotation": [], "translation": []}
    doubts: dict[str, list[np.ndarray]] = {"rotation": [], "translation": []}
    moving = []
    for index in range(count):
        batch = collate([preset.sample(sample_generator(seed, index))])
        with torch.inference_mode():
            output = predict(network, batch.inputs, next_start(network))
        valid = batch.inputs.valid[0, ::PIXEL_STRIDE, ::PIXEL_STRIDE].numpy()
        moving.append(batch.moving[0, ::PIXEL_STRIDE, ::PIXEL_STRIDE].numpy()[valid])
        for name, value, scale, target in (
            ("rotation", output.rotation, output.log_scale_rotation, batch.targets.rotation_deg),
            ("translation", output.translation, output.log_scale_translation,
             batch.targets.translation),
        ):  # fmt: skip
            error = (value - target[:, :, None, None]).abs() * (-scale).exp()
            maps = torch.cat([error, scale.mean(1, keepdim=True)], dim=1)
            maps = F.interpolate(maps, size=batch.moving.shape[1:], mode="nearest")
            maps = maps[0, :, ::PIXEL_STRIDE, ::PIXEL_STRIDE].numpy()[:, valid]
            ratios[name].append(maps[:3].ravel().astype(np.float32))
            doubts[name].append(maps[3])
    label = np.concatenate(moving)
    result: dict[str, Any] = {"pairs": count, "preset": "wide", "levels": LEVELS.tolist()}
    for name in ratios:
        ratio = np.concatenate(ratios[name])
        result[name] = {
            "mean_ratio": float(ratio.mean()),
            "median_ratio_over_ln2": float(np.median(ratio) / np.log(2)),
            "observed": [float((ratio < -np.log(1 - p)).mean()) for p in LEVELS],
            "auroc": area_under_curve(np.concatenate(doubts[name]), label),
        }
    return result


def one_mover(network: Any, seed: int, count: int) -> dict[str, Any]:
    """Rotation errors where one object covers half of the picture or more, beside the motion."""
    from hybridvo.baselines.pnp import baselines
    from hybridvo.geometry import rotation_angle
    from hybridvo.learned import estimate_learned
    from hybridvo.pipeline import refine
    from hybridvo.synthetic.diverse import DiverseOptions
    from hybridvo.training.stream import sample_generator
    from hybridvo.types import Camera, Frame, FramePair

    preset = dataclasses.replace(
        DiverseOptions(), large_mover_probability=1.0, large_coverage=COVERAGE, movers=(0, 0),
        still_probability=0.0,
    )  # fmt: skip
    methods: dict[str, Callable[[FramePair], Any]] = {
        "pwvo": lambda pair: estimate_learned(pair, "pwvo", network),
        "refine": refine,
    }
    if "poselib" in baselines():
        methods["poselib"] = baselines()["poselib"]
    errors: dict[str, list[float]] = {name: [] for name in (*methods, "zero motion")}
    shares: list[float] = []
    index = 0
    while len(shares) < count:
        sample = preset.sample(sample_generator(seed + 1, index))
        index += 1
        share = float(sample.moving.mean())
        if not COVERAGE[0] <= share <= COVERAGE[1]:
            continue
        shares.append(share)
        K = sample.K
        focal_and_centre = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        camera = Camera(*focal_and_centre, *sample.depth_prev.shape)
        pair = FramePair(
            Frame(None, sample.depth_prev, camera), Frame(None, None, camera), sample.flow
        )
        R = sample.T_curr_prev[:3, :3].astype(np.float64)
        errors["zero motion"].append(float(np.rad2deg(rotation_angle(R))))
        for name, method in methods.items():
            found = method(pair).T_curr_prev[:3, :3]
            errors[name].append(float(np.rad2deg(rotation_angle(found @ R.T))))
    zero = float(np.median(errors["zero motion"]))
    return {
        "pairs": count,
        "coverage": list(COVERAGE),
        "mean_moving_share": float(np.mean(shares)),
        "second_depth": "not given: the samples have none on a grid of its own",
        "methods": {
            name: {
                "median_deg": float(np.median(values)),
                "q75_deg": float(np.quantile(values, 0.75)),
                "over_motion": float(np.median(values)) / zero,
            }
            for name, values in errors.items()
        },
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Reliability curves and errors of the methods."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    left.plot([0, 1], [0, 1], color="0.6", lw=1, label="calibrated")
    for name, color in (("rotation", "#0b6"), ("translation", "#06c")):
        row = result["reliability"][name]
        left.plot(
            result["reliability"]["levels"], row["observed"], "o-", ms=3, color=color,
            label=f"{name}: mean |error| / U = {row['mean_ratio']:.2f}",
        )  # fmt: skip
    left.set(xlabel="stated share of errors below", ylabel="observed share")
    left.set_title("Reliability over held-out wide pairs")
    left.legend(frameon=False)
    methods = result["one_mover"]["methods"]
    right.barh(list(methods), [m["median_deg"] for m in methods.values()], color="#06c")
    right.invert_yaxis()
    right.set(xlabel="median rotation error, degrees")
    right.set_title("One mover on 50 to 80 % of the picture")
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
