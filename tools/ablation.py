"""The rows of the paper's tables, trained anew side by side: each batch is handed to every row.

    python tools/ablation.py --out runs/ablation --seeds 0 1 2
    python tools/ablation.py --out runs/full --recipe configs/ablation/recipes/full.yaml

A row is a file of configs/ablation; ``--recipe`` lays another size and optimiser over all rows.
The rows that decide the paper's order have several seeds, the others one; every row is scored on
held-out pairs at fixed numbers of samples, so that a reader sees whether an order is settled.
Started again with the same ``--out`` it goes on where it was: each row's state is ``OUT/ROW-seedN``
(checkpoint.pt, log.jsonl, result.json, and at the end weights.safetensors). ``OUT/ablation.json``
is written after every score, of all rows that are there.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
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
from hybridvo.synthetic.dataset import load_preset, read_yaml
from hybridvo.training.options import load_pwvo_options
from hybridvo.training.pwvo_task import PwvoTask
from hybridvo.training.trainer import Trainer
from hybridvo.training.validation import (
    FIGURES,
    PUBLISHED_SEED,
    TrainingBatch,
    evaluate_network,
    held_out,
)

ROWS = Path(__file__).resolve().parents[1] / "configs" / "ablation"
DECIDING = ("pwvo-paper", "pwvo-naive", "vonet", "pwvo-uncertain")
"""Rows whose order is the paper's claim: these are trained with several seeds."""
RESULT = "result.json"
"""Scores of a row, in its folder."""
CLAIMS = (
    ("pwvo-paper", "pwvo-uncertain"),
    ("pwvo-paper", "pwvo-naive"),
    ("pwvo-paper", "vonet"),
    ("pwvo-uncertain", "pwvo-naive"),
    ("pwvo-naive", "vonet"),
    *(
        (row, f"{row}-without-flow")
        for row in ("vonet", "vonet-attention", "pwvo-naive")
    ),
)
"""(better, worse) in EPE as the paper has it."""
MILESTONES = (6_000, 12_000, 25_000, 50_000, 100_000, 200_000, 400_000, 800_000)
"""Samples at which a row is scored, and at its end."""
PRESETS = ("data_paper", "data_diverse")
"""Of the held-out pairs."""


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="a folder for each row, and results",
    )
    add(
        "--configs",
        type=Path,
        default=ROWS,
        metavar="DIR",
        help="the rows (configs/ablation)",
    )
    add("--rows", help="comma-separated names (default: all)")
    add(
        "--recipe",
        type=Path,
        metavar="FILE",
        help="options laid over those of every row",
    )
    add(
        "--seeds",
        type=int,
        nargs="+",
        default=[0],
        help="above 0: of the deciding rows alone",
    )
    add(
        "--samples", type=int, default=100_000, help="training samples of every row"
    )
    add("--count", type=int, default=500, help="held-out pairs of each preset")
    add("--threads", type=int, default=1, help="threads of torch")
    add(
        "--workers",
        type=int,
        default=0,
        help="processes that draw samples (0: this one)",
    )
    add("--device", choices=("cpu", "cuda"), default="cpu")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns its exit code (2 bad input, 5 no output, 130 interrupted)."""
    args = _parser().parse_args(argv)
    torch.set_num_threads(args.threads)
    torch.backends.cudnn.benchmark = True
    # samples are small: threads inside OpenCV cost more than they give
    cv2.setNumThreads(0)
    try:
        known = sorted(
            path.stem for path in args.configs.glob("*.yaml") if path.stem != "base"
        )
        names = known if args.rows is None else args.rows.split(",")
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise InputError(
                f"--rows: unknown {', '.join(unknown)}; known: {', '.join(known)}."
            )
        ablation = Ablation(args)
        for seed in args.seeds:
            ablation.train([n for n in names if seed == 0 or n in DECIDING], seed)
    except HybridVOError as error:
        print(f"ablation.py: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("ablation.py: interrupted; start again to go on.", file=sys.stderr)
        return 130
    return 0


class Row:
    """One row of one seed: its training, its folder and its scores."""

    def __init__(self, args: argparse.Namespace, name: str, seed: int) -> None:
        changes = {} if args.recipe is None else read_yaml(args.recipe)
        options, mixture = load_pwvo_options(args.configs / f"{name}.yaml", changes)
        steps = -(-args.samples // options.batch_size)
        options = dataclasses.replace(options, seed=seed, steps=steps)
        self.args = args
        self.name = name
        self.options = options
        self.folder = args.out / f"{name}-seed{seed}"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.trainer = Trainer(PwvoTask(options, mixture), self.folder, args.device)
        self.trainer.resume()
        self.stream = json.dumps(
            [self.trainer.task.data, options.data_weights, options.batch_size]
        )
        parameters = sum(p.numel() for p in self.trainer.network.parameters())
        self.result = {
            "row": name,
            "seed": seed,
            "parameters": parameters,
            "curve": {},
        }
        if (self.folder / RESULT).exists():
            self.result = json.loads(
                (self.folder / RESULT).read_text(encoding="utf-8")
            )

    def score(self) -> bool:
        """Whether the row was scored, as it is where it is due; at the end by every rule."""
        options = self.options
        samples = self.trainer.samples
        curve = self.result["curve"]
        due = [
            m
            for m in (*MILESTONES, self.args.samples)
            if m <= samples < m + options.batch_size
        ]
        if not due or str(due[-1]) in curve:
            return False
        last = self.trainer.step == options.steps
        pairs = pairs_of(options.data_size, self.args.count)
        scores: dict[str, Any] = {"seconds": round(self.trainer.elapsed_s)}
        for preset, batches in pairs.items():
            figures = evaluate_network(
                self.trainer.exported, batches, options.selection
            )
            scores[preset] = figures
            if last and figures["auroc_rotation"] is not None:
                rules = scores[f"rules_{preset}"] = {}
                for rule in SELECTION_METHODS:
                    found = figures
                    if rule != options.selection:
                        found = evaluate_network(
                            self.trainer.exported, batches, rule
                        )
                    rules[rule] = {key: found[key] for key in FIGURES}
        curve[str(due[-1])] = scores
        write_json(self.folder / RESULT, self.result)
        self.trainer.save()
        if last:
            made = provenance("ablation.py", None)
            card = {
                "row": self.name,
                "command": made["command"],
                "commit": made["commit"],
            }
            card |= self.trainer.record | {"curve": curve}
            save_weights(
                self.folder / "weights.safetensors", self.trainer.exported, card
            )
        short = ", ".join(f"{p} EPE {scores[p]['epe']:.3f} px" for p in pairs)
        name = f"{self.name} seed {self.result['seed']}"
        print(f"{name}, {due[-1]}: {short}", file=sys.stderr, flush=True)
        return True


@functools.cache
def pairs_of(
    size: tuple[int, int] | None, count: int
) -> dict[str, list[TrainingBatch]]:
    """The held-out pairs of each preset in a size, drawn on first use."""
    presets = {
        name: load_preset(ROWS.parent / f"{name}.yaml", size) for name in PRESETS
    }
    return {
        name: held_out(preset, PUBLISHED_SEED, count)
        for name, preset in presets.items()
    }


class Ablation:
    """The training of the rows, which a signal stops."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.stop = False
        # the update at hand ends, with a checkpoint
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: setattr(self, "stop", True))

    def train(self, names: Sequence[str], seed: int) -> None:
        """Train rows side by side, from where each was."""
        rows = [Row(self.args, name, seed) for name in names]
        while behind := [
            row for row in rows if row.trainer.step < row.options.steps
        ]:
            # those furthest behind go on until they reach the next ones
            step, stream = min((row.trainer.step, row.stream) for row in behind)
            group = [
                r for r in behind if (r.trainer.step, r.stream) == (step, stream)
            ]
            steps = {r.trainer.step for r in rows if r.trainer.step > step}
            last = min({*steps, group[0].options.steps})
            task = group[0].trainer.task
            for batch in task.batches(group[0].trainer.samples, self.args.workers):
                batch = batch.to(self.args.device)
                for row in group:
                    row.trainer.advance(batch)
                if any([row.score() for row in group]):
                    write_json(self.args.out / "ablation.json", summary(self.args))
                if group[0].trainer.step == last or self.stop:
                    break
            if self.stop:
                for row in rows:
                    row.trainer.save()
                raise KeyboardInterrupt


def summary(args: argparse.Namespace) -> dict[str, Any]:
    """What stands in ablation.json: every curve, and the paper's claims by differences."""
    files = sorted(args.out.glob(f"*/{RESULT}"))
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in files]
    counts = sorted({int(k) for run in runs for k in run["curve"]})
    claims = [
        {"preset": preset, "samples": samples, **found}
        for preset in PRESETS
        for samples in counts
        for better, worse in CLAIMS
        if (found := claim(runs, better, worse, preset, str(samples))) is not None
    ]
    return {
        **provenance("ablation.py", None),
        "samples": args.samples,
        "held_out": {"count": args.count, "presets": list(PRESETS)},
        "epe": "component mean, px at the size of the samples",
        "claims": claims,
        "runs": [without_pairs(run) for run in runs],
    }


def claim(
    runs: list[dict[str, Any]], better: str, worse: str, preset: str, samples: str
) -> dict[str, Any] | None:
    """Difference in EPE of two rows over common seeds and over pairs; None if not there."""

    def epe_of_pairs(row: str) -> dict[int, Any]:
        """By seed, of the runs that were scored there."""
        return {
            run["seed"]: np.array(run["curve"][samples][preset]["epe_of_pairs"])
            for run in runs
            if run["row"] == row
            and "epe_of_pairs" in run["curve"].get(samples, {}).get(preset, {})
        }

    ours = epe_of_pairs(better)
    others = epe_of_pairs(worse)
    common = [seed for seed in ours if seed in others]
    if not common:
        return None
    differences = np.array([ours[seed] - others[seed] for seed in common])
    of_seeds = differences.mean(axis=1)
    over_pairs = differences.mean(axis=0)
    spread = round(float(of_seeds.std(ddof=1)), 4) if len(common) > 1 else None
    return {
        "better": better,
        "worse": worse,
        "difference_px": round(float(of_seeds.mean()), 4),
        "spread_of_seeds_px": spread,
        "error_over_pairs_px": round(
            float(over_pairs.std() / np.sqrt(over_pairs.size)), 4
        ),
        "as_claimed": f"{int((of_seeds < 0).sum())} of {len(common)}",
    }


def without_pairs(value: Any) -> Any:
    """The figures without those of each pair."""
    if not isinstance(value, dict):
        return value
    return {k: without_pairs(v) for k, v in value.items() if k != "epe_of_pairs"}


if __name__ == "__main__":
    raise SystemExit(main())
