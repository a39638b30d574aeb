"""The rows of the paper's tables, trained anew under one budget on the same pairs.

    hybridvo generate --preset paper --size 64 128 --count 100000 --out runs/paper_samples
    python tools/ablation.py --out runs/ablation --data runs/paper_samples --seeds 3

A row is a file of configs/ablation. The rows that decide the paper's order have several seeds, the
others one; every row is scored on held-out pairs at 6, 12, 25, 50 and 100 thousand samples, so that
a reader sees whether an order is settled. Started again with the same ``--out`` it goes on where it
was: each row's state is ``OUT/ROW-seedN`` (checkpoint.pt, log.jsonl, result.json, and at the end
weights.safetensors). ``OUT/ablation.json`` is written after every score, with what is there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from measuring import parser_of, provenance

from hybridvo.errors import HybridVOError, InputError
from hybridvo.files import write_json
from hybridvo.network.selection import SELECTION_METHODS
from hybridvo.network.weights import save_weights
from hybridvo.synthetic.dataset import Mixture, StoredSamples, load_preset
from hybridvo.training.options import PwvoOptions, load_pwvo_options
from hybridvo.training.pwvo_task import PwvoTask
from hybridvo.training.trainer import Trainer
from hybridvo.training.validation import FIGURES, PUBLISHED_SEED, evaluate_network

ROWS = Path(__file__).resolve().parents[1] / "configs" / "ablation"
DECIDING = ("pwvo-paper", "pwvo-naive", "vonet", "pwvo-uncertain")
"""Rows whose order is the paper's claim: these are trained with several seeds."""
CLAIMS = (
    ("pwvo-paper", "pwvo-uncertain"),
    ("pwvo-paper", "pwvo-naive"),
    ("pwvo-paper", "vonet"),
    ("pwvo-uncertain", "pwvo-naive"),
    ("pwvo-naive", "vonet"),
    *((row, f"{row}-without-flow") for row in ("vonet", "vonet-attention", "pwvo-naive")),
)
"""(better, worse) in EPE as the paper has it."""
MILESTONES = (6_000, 12_000, 25_000, 50_000, 100_000)
"""Samples at which a row is scored, and at its end."""
PRESETS = ("data_paper", "data_diverse")
"""Of the held-out pairs."""


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="a folder for each row, and results")
    add("--configs", type=Path, default=ROWS, metavar="DIR", help="the rows (configs/ablation)")
    add("--rows", help="comma-separated names (default: all)")
    add("--seeds", type=int, default=1, help="seeds of the rows that decide the order")
    add("--samples", type=int, default=100_000, help="training samples of every row")
    add("--data", type=Path, metavar="DIR", help="stored samples instead of drawn ones")
    add("--count", type=int, default=500, help="held-out pairs of each preset")
    add("--threads", type=int, default=1, help="threads of torch")
    add("--workers", type=int, default=0, help="processes that draw samples (0: this one)")
    add("--device", choices=("cpu", "cuda"), default="cpu")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns its exit code (2 bad input, 5 no output, 130 interrupted)."""
    args = _parser().parse_args(argv)
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(0)  # samples are small: threads inside OpenCV cost more than they give
    try:
        known = sorted(path.stem for path in args.configs.glob("*.yaml") if path.stem != "base")
        names = known if args.rows is None else args.rows.split(",")
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise InputError(f"--rows: unknown {', '.join(unknown)}; known: {', '.join(known)}.")
        first = [name for name in DECIDING if name in names]
        order = [(name, 0) for name in dict.fromkeys([*first, *names])]
        order += [(name, seed) for seed in range(1, args.seeds) for name in first]
        ablation = Ablation(args)
        for name, seed in order:
            ablation.train(name, seed)
    except HybridVOError as error:
        print(f"ablation.py: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("ablation.py: interrupted; start again to go on.", file=sys.stderr)
        return 130
    return 0


class Ablation:
    """The rows so far, by name and seed."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.runs: dict[tuple[str, int], dict[str, Any]] = {}

    def train(self, name: str, seed: int) -> None:
        """Train and score one row, from where it was."""
        args, task = self.args, self.task(name, seed)
        folder = args.out / f"{name}-seed{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        trainer = Trainer(task, folder, args.device, args.workers)
        trainer.resume()
        for number in (signal.SIGINT, signal.SIGTERM):  # the update at hand ends, with a checkpoint
            signal.signal(number, lambda *_: setattr(trainer, "stop_requested", True))
        result: dict[str, Any] = {"row": name, "seed": seed, "curve": {}}
        if (folder / "result.json").exists():
            result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        result["parameters"] = sum(p.numel() for p in trainer.network.parameters())
        self.runs[name, seed] = result
        for samples in sorted({m for m in MILESTONES if m < args.samples} | {args.samples}):
            if trainer.run(until=-(-samples // task.options.batch_size)) == "signal":
                raise KeyboardInterrupt
            if str(samples) not in result["curve"]:
                scores = self.scores(trainer.exported, task.options, samples == args.samples)
                result["curve"][str(samples)] = {"seconds": round(trainer.elapsed_s), **scores}
                short = ", ".join(f"{p} EPE {scores[p]['epe']:.3f} px" for p in PRESETS)
                print(f"{name} seed {seed}, {samples}: {short}", file=sys.stderr, flush=True)
            write_json(folder / "result.json", result)
            write_json(args.out / "ablation.json", self.summary())
        made = provenance("ablation.py", None)
        card = {"row": name, "command": made["command"], "commit": made["commit"]}
        card |= trainer.record | {"curve": result["curve"]}
        save_weights(folder / "weights.safetensors", trainer.exported, card, "float16")

    def task(self, name: str, seed: int) -> PwvoTask:
        """The training of a row."""
        args = self.args
        options, mixture = load_pwvo_options(args.configs / f"{name}.yaml")
        steps = -(-args.samples // options.batch_size)
        options = dataclasses.replace(options, seed=seed, steps=steps)
        if args.data is not None:
            mixture = Mixture((StoredSamples(str(args.data.resolve())),), (1.0,))
            options = dataclasses.replace(options, data=("folder",), data_weights=(1.0,))
        return PwvoTask(options, mixture)

    def scores(self, network: Any, recipe: PwvoOptions, last: bool) -> dict[str, Any]:
        """Figures on held-out pairs of each preset; at the end by every rule of the selection."""
        scores: dict[str, Any] = {}
        selection = recipe.selection
        for name in PRESETS:
            preset = load_preset(ROWS.parent / f"{name}.yaml", recipe.data_size)
            asked = preset, PUBLISHED_SEED, self.args.count
            figures = scores[name] = evaluate_network(network, *asked, selection=selection)
            if last and figures["auroc_rotation"] is not None:
                rules = scores[f"rules_{name}"] = {}
                for rule in SELECTION_METHODS:
                    found = figures
                    if rule != selection:
                        found = evaluate_network(network, *asked, selection=rule)
                    rules[rule] = {key: found[key] for key in FIGURES}
        return scores

    def summary(self) -> dict[str, Any]:
        """What stands in ablation.json: every curve, and the paper's claims by differences."""
        counts = sorted({int(k) for run in self.runs.values() for k in run["curve"]})
        claims = [
            {"preset": preset, "samples": samples, **claim}
            for preset in PRESETS
            for samples in counts
            for better, worse in CLAIMS
            if (claim := self.claim(better, worse, preset, str(samples))) is not None
        ]
        return {
            **provenance("ablation.py", None),
            "samples": self.args.samples,
            "held_out": {"count": self.args.count, "presets": list(PRESETS)},
            "epe": "component mean, px at the size of the samples",
            "claims": claims,
            "runs": [without_pairs(run) for run in self.runs.values()],
        }

    def claim(self, better: str, worse: str, preset: str, samples: str) -> dict[str, Any] | None:
        """Difference in EPE of two rows over common seeds and over pairs; None if not there."""

        def epe_of_pairs(row: str) -> dict[int, Any]:
            """By seed, of the runs that were scored there."""
            return {
                seed: np.array(run["curve"][samples][preset]["epe_of_pairs"])
                for (name, seed), run in self.runs.items()
                if name == row and "epe_of_pairs" in run["curve"].get(samples, {}).get(preset, {})
            }

        ours, others = epe_of_pairs(better), epe_of_pairs(worse)
        common = [seed for seed in ours if seed in others]
        if not common:
            return None
        differences = np.array([ours[seed] - others[seed] for seed in common])
        of_seeds, over_pairs = differences.mean(axis=1), differences.mean(axis=0)
        spread = round(float(of_seeds.std(ddof=1)), 4) if len(common) > 1 else None
        return {
            "better": better,
            "worse": worse,
            "difference_px": round(float(of_seeds.mean()), 4),
            "spread_of_seeds_px": spread,
            "error_over_pairs_px": round(float(over_pairs.std() / np.sqrt(over_pairs.size)), 4),
            "as_claimed": f"{int((of_seeds < 0).sum())} of {len(common)}",
        }


def without_pairs(value: Any) -> Any:
    """The figures without those of each pair."""
    if not isinstance(value, dict):
        return value
    return {k: without_pairs(v) for k, v in value.items() if k != "epe_of_pairs"}


if __name__ == "__main__":
    raise SystemExit(main())
