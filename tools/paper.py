"""Figures and statistics of the paper's page, from the rows that
``tools/ablation.py`` trained.

    python tools/paper.py --ablation runs/ablation            # figures, docs/results/paper.json
    python tools/paper.py --ablation runs/ablation --install  # and keep the weights
    python tools/paper.py --cards   # score the rows of hybridvo_lab/weights anew
    python tools/paper.py --rules --out docs/results/paper_rules.json

Draws the five steps of the data workflow, the saliency of VONet and PWVO
(integrated gradients), the uncertainty beside the error and the objects' flow,
and the factorised flow beside the ground truth; measures on held-out pairs
which fraction of the saliency lies on moving pixels. ``make_docs.py`` fills
docs/paper.md from the JSON files.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from ablation import without_pairs
from measuring import ROOT, parser_of, provenance, store, without_folders
from safetensors import safe_open
from safetensors.torch import save

from hybridvo.core.files import atomic_write, write_json
from hybridvo.flow.colours import longest_flow
from hybridvo.network.models import load_weights
from hybridvo.network.selection import SELECTION_METHODS, select_motion
from hybridvo.network.weights import (
    checksum,
    save_weights,
    weights_file,
)
from hybridvo_lab.commands.train import write_sheet
from hybridvo_lab.synthetic.dataset import load_preset, make_preset
from hybridvo_lab.synthetic.draws import sample_generator
from hybridvo_lab.training.validation import (
    PUBLISHED_SEED,
    collate,
    evaluate_network,
    held_out,
)
from hybridvo_lab.visualization.pair import prediction_panels
from hybridvo_lab.visualization.panels import (
    Panel,
    flow_panel,
    write_panels,
)
from hybridvo_lab.visualization.saliency import network_saliencies, saliency_panels

PAPER_WEIGHTS = ROOT / "hybridvo_lab" / "weights"
"""The package of the rows' weights."""
ROWS = {
    "vonet": "VONet",
    "vonet-attention": "VONet + self-attention",
    "pixelwise": "+ pixel-wise",
    "pwvo-naive": "+ U^R + U^T (PWVO naive)",
    "pwvo-uncertain": "+ U^D + U^F",
    "pwvo-paper": "+ selection (PWVO)",
}
"""Rows of the paper's tables, and their names there."""
COMPARED = ("vonet", "pwvo-paper")
"""Rows whose saliency the paper compares."""
SHOWN = 2
"""Held-out pairs of a figure."""
MIN_MOVING = 0.05
"""Smallest fraction of moving pixels of a pair that is shown or measured."""
MAX_MOVING = 0.5
"""Largest fraction of moving pixels of a pair that is shown."""
STEPS = 16
"""Nodes of the integrated gradients."""
HEIGHT = 64
WIDTH = 128
"""Rows and columns of the rows' inputs."""
TRAINED = {
    "pwvo-paper": "exact inputs",
    "pwvo-paper-noisy": "noise and random masks",
}
"""Rows of section 6 of the paper, and their training data."""
TESTED = {
    "true": {"preset": "paper"},
    "noisy": {"preset": "paper", "degraded_share": 1.0},
    "dis": {"preset": "diverse", "dis_share": 1.0},
}
"""Inputs on which they are tested."""
CARD_PRESET = "data_paper"
"""Data on which a card is scored."""
CARD_PAIRS = 500
"""Held-out pairs by which a card is scored, as ``tools/ablation.py`` does."""
DIS_STRIDE = 4
"""The networks read every so many-th pixel; DIS needs larger images."""


def main(argv: list[str] | None = None) -> int:
    """Run the tool."""
    parser = build_parser()
    args = parser.parse_args(argv)
    if args.cards:
        score_cards(argv)
        return 0
    if args.rules:
        rules = rules_of_shipped(args.pairs)
        for name, errors in (rules["rules"] | rules["rows"]).items():
            print(f"{name}: EPE {errors['epe']:.3f} px")
        store(args.out, provenance("paper.py", argv) | rules)
        return 0
    if args.ablation is None:
        parser.error("expected --ablation DIR, the output of tools/ablation.py")
    weights = {
        name: args.ablation / f"{name}-seed0" / "weights.safetensors"
        for name in ROWS
    }
    weights = {name: path for name, path in weights.items() if path.is_file()}
    networks = {name: load_weights(path)[0] for name, path in weights.items()}
    preset = load_preset(ROOT / "configs/data_paper.yaml", size=(HEIGHT, WIDTH))
    samples = [
        preset.sample(sample_generator(PUBLISHED_SEED, i))
        for i in range(args.pairs)
    ]
    draw_figures(networks, samples)

    saliency = {
        name: saliency_on_moving(networks[name], samples)
        for name in COMPARED
        if name in networks
    }
    record = {
        "pairs": args.pairs,
        "seed": PUBLISHED_SEED,
        "saliency": saliency,
        "inputs": inputs_table(args.ablation, args.pairs),
        **provenance("paper.py", argv),
    }
    results = ROOT / "docs" / "results"
    write_json(results / "paper.json", record)
    text = (args.ablation / "ablation.json").read_text(encoding="utf-8")
    write_json(results / "ablation.json", json.loads(text))
    if args.install:
        for name, path in weights.items():
            install(name, path)
    return 0


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add(
        "--ablation",
        type=Path,
        metavar="DIR",
        help="the output of tools/ablation.py",
    )
    add("--pairs", type=int, default=200, help="held-out pairs of the statistics")
    add(
        "--install",
        action="store_true",
        help="copy the rows' weights into hybridvo_lab/weights",
    )
    add(
        "--cards",
        action="store_true",
        help="only score those rows on the held-out pairs, and write their cards",
    )
    add(
        "--rules",
        action="store_true",
        help="only measure the selection rules on the PWVO of hybridvo_lab/weights",
    )
    add("--out", type=Path, metavar="FILE", help="what --rules writes")
    return parser


def rules_of_shipped(pairs: int) -> dict[str, Any]:
    """Errors of the shipped PWVO by each selection rule, and those of two other rows."""
    preset = load_preset(ROOT / f"configs/{CARD_PRESET}.yaml", size=(HEIGHT, WIDTH))
    batches = held_out(preset, PUBLISHED_SEED, pairs)

    def errors_of(name: str, rule: str = "softmax") -> dict[str, Any]:
        network, _ = load_weights(name)
        network.options = dataclasses.replace(network.options, input_stride=1)
        return without_pairs(evaluate_network(network, batches, rule))

    return {
        "pairs": pairs,
        "rules": {
            rule: errors_of("pwvo-paper", rule) for rule in SELECTION_METHODS
        },
        "rows": {name: errors_of(name) for name in ("vonet", "pwvo-naive")},
    }


def install(name: str, path: Path) -> None:
    """Put a row into ``hybridvo_lab/weights``.

    There it reads every second pixel of the usual 128x256 inputs.
    """
    network, card = load_weights(path)
    card = without_folders(card)
    network.options = dataclasses.replace(network.options, input_stride=2)
    curve = card.pop("curve")
    scores = curve[max(curve, key=int)]
    card["held_out"] = {CARD_PRESET: without_pairs(scores[CARD_PRESET])}
    save_weights(PAPER_WEIGHTS / f"{name}.safetensors", network, card)
    write_json(PAPER_WEIGHTS / f"{name}.json", card)


# --- cards ------------------------------------------------------------------------


def score_cards(argv: list[str] | None) -> None:
    """Write the figures of the rows in ``hybridvo_lab/weights`` into their cards.

    Only on the paper's data, which stay as they are. The scenes of the diverse data change
    with the package, and figures on them grow old in a file.
    """
    preset = load_preset(ROOT / f"configs/{CARD_PRESET}.yaml", size=(HEIGHT, WIDTH))
    batches = held_out(preset, PUBLISHED_SEED, CARD_PAIRS)
    for name in ROWS:
        network, card = load_weights(name)
        network.options = dataclasses.replace(network.options, input_stride=1)
        selection = card["options"]["selection"]
        figures = evaluate_network(network, batches, selection)
        card["held_out"] = {CARD_PRESET: without_pairs(figures)}
        card["held_out_by"] = provenance("paper.py", argv)["command"]
        write_card(name, card)


def write_card(name: str, card: dict[str, Any]) -> None:
    """Replace the card of weights in their file; the tensors stay bit by bit."""
    path = weights_file(name)
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}
    header["card"] = json.dumps(card, sort_keys=True, allow_nan=False)
    header["checksum"] = checksum(tensors, header)
    with atomic_write(path, "wb") as file:
        file.write(save(tensors, header))
    write_json(path.with_suffix(".json"), card)


# --- statistics -------------------------------------------------------------------


def inputs_table(ablation: Path, pairs: int) -> dict[str, Any]:
    """EPE, px of 64x128, of PWVO trained and tested on exact,
    noisy and estimated inputs.
    """
    titles = (*TRAINED.values(), "zero motion")
    table: dict[str, Any] = {title: {} for title in titles}
    size = {"height": HEIGHT * DIS_STRIDE, "width": WIDTH * DIS_STRIDE}
    for inputs, options in TESTED.items():
        preset = make_preset(options | size, inputs)
        batches = held_out(preset, PUBLISHED_SEED, pairs)
        for row, title in TRAINED.items():
            path = ablation / f"{row}-seed0" / "weights.safetensors"
            network, _ = load_weights(path)
            network.options = dataclasses.replace(
                network.options, input_stride=DIS_STRIDE
            )
            figures = evaluate_network(network, batches)
            table[title][inputs] = figures["epe"] / DIS_STRIDE
            table["zero motion"][inputs] = figures["zero_epe"] / DIS_STRIDE
    return table


def saliency_on_moving(network: Any, samples: list[Any]) -> dict[str, Any]:
    """Fraction of the saliency on moving pixels over their fraction of
    the image, mean over pairs.
    """
    ratios: dict[str, list[float]] = {"rotation": [], "translation": []}
    for sample in samples:
        moving_fraction = float(sample.moving.mean())
        if moving_fraction < MIN_MOVING:
            continue
        moving = sample.moving.astype(np.uint8)
        inputs = collate([sample]).inputs
        maps = network_saliencies(network, inputs, STEPS)
        for part, saliency in maps.items():
            mask = cv2.resize(
                moving, saliency.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT
            )
            total = saliency.sum()
            if total > 0:
                fraction = float(saliency[mask > 0].sum() / total)
                ratios[part].append(fraction / moving_fraction)
    result: dict[str, Any] = {}
    for part, values in ratios.items():
        result[part] = {
            "mean": float(np.mean(values)),
            "standard_error": float(np.std(values) / np.sqrt(len(values))),
            "pairs": len(values),
        }
    return result


# --- figures ----------------------------------------------------------------------


def draw_figures(networks: dict[str, Any], samples: list[Any]) -> None:
    """Write the figures of the page for which there are networks."""
    shown = [s for s in samples if MIN_MOVING < s.moving.mean() < MAX_MOVING]
    shown = shown[:SHOWN]
    folder = ROOT / "docs" / "figures"
    write_sheet(shown, folder / "paper_workflow.png")
    if set(COMPARED) <= set(networks):
        panels = []
        for sample in shown:
            for name in COMPARED:
                panels += saliency_of(name, networks[name], sample)
        write(folder / "paper_saliency.png", panels, "Where the networks look")
    if "pwvo-paper" in networks:
        network = networks["pwvo-paper"]
        panels = uncertainty_panels(network, shown[0])
        heading = "Uncertainty, error and object flow"
        write(folder / "paper_uncertainty.png", panels, heading)
        panels = factorised_panels(network, shown[0])
        heading = "Flow in parts beside the ground truth"
        write(folder / "paper_flow.png", panels, heading)


def saliency_of(name: str, network: Any, sample: Any) -> list[Panel]:
    """The saliency of rotation and translation, with the
    outline of the moving objects.
    """
    inputs = collate([sample]).inputs
    maps = network_saliencies(network, inputs, STEPS)
    return saliency_panels(name, maps, sample.moving)


def uncertainty_panels(network: Any, sample: Any) -> list[Panel]:
    """Uncertainty and error of rotation and translation, and the objects' flow."""
    batch = collate([sample])
    with torch.no_grad():
        output = network(batch.inputs)
    true = sample.rotation_deg, sample.translation
    object_flow = sample.flow - sample.ego_flow
    longest = longest_flow(sample.flow)
    return [
        flow_panel("total flow", sample.flow, longest),
        flow_panel("flow of the objects", object_flow, longest),
        *prediction_panels(output, true, sample.moving),
    ]


def factorised_panels(network: Any, sample: Any) -> list[Panel]:
    """Ego and object flow of the estimate beside the true ones."""
    batch = collate([sample])
    with torch.no_grad():
        T = select_motion(network(batch.inputs))
    estimated = batch.targets.reconstruct(T)[0][0].permute(1, 2, 0).numpy()
    longest = longest_flow(sample.flow)
    flows = {
        "ego flow, estimate": estimated,
        "ego flow, ground truth": sample.ego_flow,
        "object flow, estimate": sample.flow - estimated,
        "object flow, ground truth": sample.flow - sample.ego_flow,
    }
    return [flow_panel(title, flow, longest) for title, flow in flows.items()]


def write(path: Path, panels: list[Panel], heading: str) -> None:
    """Write panels as a PNG."""
    write_panels(path, panels, heading, 2.0)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
