"""Figures and statistics of the paper's page, from the rows that ``tools/ablation.py`` trained.

    python tools/paper.py --ablation runs/ablation            # figures, docs/results/paper.json
    python tools/paper.py --ablation runs/ablation --install  # and put the rows into the package

Draws the five steps of the data workflow, where VONet and PWVO look (integrated gradients), the
uncertainty beside the error and the objects' flow, and the factorised flow beside the ground truth;
measures on held-out pairs which share of the saliency lies on moving pixels. ``make_docs.py`` fills
docs/paper.md from the JSON files.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from ablation import without_pairs
from measuring import ROOT, parser_of, provenance, without_folders

from hybridvo.commands.train import write_sheet
from hybridvo.files import write_json
from hybridvo.network.models import load_weights
from hybridvo.network.selection import select_motion
from hybridvo.network.weights import PRETRAINED, save_weights
from hybridvo.synthetic.dataset import load_preset, make_preset
from hybridvo.synthetic.draws import sample_generator
from hybridvo.training.validation import (
    PUBLISHED_SEED,
    collate,
    evaluate_network,
    held_out,
)
from hybridvo.visualization.pair import prediction_panels
from hybridvo.visualization.panels import (
    Panel,
    flow_panel,
    longest_flow,
    write_panels,
)
from hybridvo.visualization.saliency import saliencies, saliency_panels

ROWS = {
    "vonet": "VONet",
    "vonet-attention": "VONet + self-attention",
    "pixelwise": "+ pixel-wise",
    "pwvo-naive": "+ U^R + U^T (PWVO naive)",
    "pwvo-uncertain": "+ U^D + U^F",
    "pwvo-paper": "+ selection (PWVO)",
}
"""Rows of the paper's tables, and what it calls them."""
COMPARED = ("vonet", "pwvo-paper")
"""Rows whose saliency the paper sets beside each other."""
SHOWN = 2
"""Held-out pairs of a figure."""
MIN_MOVING = 0.05
MAX_MOVING = 0.5
"""Share of moving pixels of the pairs that are shown: a mover must be there to be looked at."""
STEPS = 16
"""Nodes of the integrated gradients."""
TRAINED = {
    "pwvo-paper": "exact inputs",
    "pwvo-paper-noisy": "noise and random masks",
}
TESTED = {
    "true": {"preset": "paper"},
    "noisy": {"preset": "paper", "degraded_share": 1.0},
    "dis": {"preset": "diverse", "dis_share": 1.0},
}
"""What PWVO is trained and tested on, section 6 of the paper."""
DIS_STRIDE = 4
"""The networks' inputs are every so many-th pixel of the images: DIS needs them larger."""


def main(argv: list[str] | None = None) -> int:
    """Run the tool."""
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add(
        "--ablation",
        type=Path,
        required=True,
        metavar="DIR",
        help="of tools/ablation.py",
    )
    add("--pairs", type=int, default=200, help="held-out pairs of the statistics")
    add(
        "--install",
        action="store_true",
        help="copy the rows' weights into the package",
    )
    args = parser.parse_args(argv)
    rows = {
        name: args.ablation / f"{name}-seed0" / "weights.safetensors"
        for name in ROWS
    }
    networks = {
        name: load_weights(path)[0] for name, path in rows.items() if path.is_file()
    }
    preset = load_preset(ROOT / "configs" / "data_paper.yaml", size=(64, 128))
    samples = [
        preset.sample(sample_generator(PUBLISHED_SEED, i))
        for i in range(args.pairs)
    ]
    shown = [s for s in samples if MIN_MOVING < s.moving.mean() < MAX_MOVING][
        :SHOWN
    ]

    figures = ROOT / "docs" / "figures"
    docs = ROOT / "docs" / "results"
    write_sheet(shown, figures / "paper_workflow.png")
    if set(COMPARED) <= set(networks):
        panels = [
            p
            for s in shown
            for name in COMPARED
            for p in saliency(name, networks[name], s)
        ]
        write(figures / "paper_saliency.png", panels, "Where the networks look")
    if "pwvo-paper" in networks:
        two = networks["pwvo-paper"], shown[0]
        heading = "Uncertainty, error and object flow"
        write(figures / "paper_uncertainty.png", uncertainty(*two), heading)
        heading = "Flow in parts beside the ground truth"
        write(figures / "paper_flow.png", factorised(*two), heading)
    shares = {
        name: saliency_on_movers(networks[name], samples)
        for name in COMPARED
        if name in networks
    }
    record = {
        "pairs": args.pairs,
        "seed": PUBLISHED_SEED,
        "saliency": shares,
        "inputs": inputs_table(args.ablation, args.pairs),
        **provenance("paper.py", argv),
    }
    write_json(docs / "paper.json", record)
    content = json.loads(
        (args.ablation / "ablation.json").read_text(encoding="utf-8")
    )
    write_json(docs / "ablation.json", content)
    if args.install:
        for name, path in rows.items():
            if path.is_file():
                install(name, path)
    return 0


def inputs_table(ablation: Path, pairs: int) -> dict[str, Any]:
    """EPE, px of 64x128, of PWVO trained and tested on exact, noisy and estimated inputs."""
    table: dict[str, Any] = {
        title: {} for title in (*TRAINED.values(), "zero motion")
    }
    for inputs, options in TESTED.items():
        size = {"height": 64 * DIS_STRIDE, "width": 128 * DIS_STRIDE}
        batches = held_out(
            make_preset(options | size, inputs), PUBLISHED_SEED, pairs
        )
        for row, title in TRAINED.items():
            network = load_weights(
                ablation / f"{row}-seed0" / "weights.safetensors"
            )[0]
            network.options = dataclasses.replace(
                network.options, input_stride=DIS_STRIDE
            )
            figures = evaluate_network(network, batches)
            table[title][inputs] = figures["epe"] / DIS_STRIDE
            table["zero motion"][inputs] = figures["zero_epe"] / DIS_STRIDE
    return table


def install(name: str, path: Path) -> None:
    """Put a row into the package; there it reads every second pixel of the usual 128x256 inputs."""
    network, card = load_weights(path)
    card = without_folders(card)
    network.options = dataclasses.replace(network.options, input_stride=2)
    curve = card.pop("curve")
    scores = curve[max(curve, key=int)]
    card["held_out"] = without_pairs(
        {k: v for k, v in scores.items() if k.startswith("data_")}
    )
    save_weights(PRETRAINED / f"{name}.safetensors", network, card)
    write_json(PRETRAINED / f"{name}.json", card)


def predict(network: Any, sample: Any) -> tuple[Any, Any]:
    """(batch of one, output) of a sample."""
    batch = collate([sample])
    with torch.no_grad():
        return batch, network(batch.inputs)


def saliency(name: str, network: Any, sample: Any) -> list[Panel]:
    """What decides rotation and translation, with the outline of what moves."""
    found = saliencies(network, collate([sample]).inputs, None, STEPS)
    return saliency_panels(name, found, sample.moving)


def saliency_on_movers(network: Any, samples: list[Any]) -> dict[str, Any]:
    """Share of the saliency on moving pixels over their share of the image, mean over pairs."""
    ratios: dict[str, list[float]] = {"rotation": [], "translation": []}
    for sample in samples:
        moving = float(sample.moving.mean())
        if moving < MIN_MOVING:
            continue
        for what, found in saliencies(
            network, collate([sample]).inputs, None, STEPS
        ).items():
            size = found.shape[::-1]
            mode = cv2.INTER_NEAREST_EXACT
            mask = cv2.resize(
                sample.moving.astype(np.uint8), size, interpolation=mode
            )
            if found.sum() > 0:
                ratios[what].append(
                    float(found[mask > 0].sum() / found.sum()) / moving
                )
    result: dict[str, Any] = {}
    for what, values in ratios.items():
        result[what] = {
            "mean": float(np.mean(values)),
            "standard_error": float(np.std(values) / np.sqrt(len(values))),
            "pairs": len(values),
        }
    return result


def uncertainty(network: Any, sample: Any) -> list[Panel]:
    """Uncertainty of both halves, their errors, and the objects' flow."""
    _, output = predict(network, sample)
    true = sample.rotation_deg, sample.translation
    objects = sample.flow - sample.ego_flow
    longest = longest_flow(sample.flow)
    total = flow_panel("total flow", sample.flow, longest)
    flows = [total, flow_panel("flow of the objects", objects, longest)]
    return [*flows, *prediction_panels(output, true, sample.moving)]


def factorised(network: Any, sample: Any) -> list[Panel]:
    """Ego and object flow of the estimate beside the true ones."""
    batch, output = predict(network, sample)
    T = select_motion(output)
    gt = batch.targets
    ego = gt.reconstruct(T)[0][0].permute(1, 2, 0).numpy()
    longest = longest_flow(sample.flow)
    flows = {
        "ego flow, estimate": ego,
        "ego flow, ground truth": sample.ego_flow,
        "object flow, estimate": sample.flow - ego,
        "object flow, ground truth": sample.flow - sample.ego_flow,
    }
    return [flow_panel(title, flow, longest) for title, flow in flows.items()]


def write(path: Path, panels: list[Panel], heading: str) -> None:
    """Panels as a PNG."""
    write_panels(path, panels, heading, 2.0)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
