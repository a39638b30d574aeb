"""The rows of the paper's tables, trained side by side: every
row gets the same batches.

    python tools/ablation.py --out runs/ablation --seeds 0 1 2
    python tools/ablation.py --out runs/full --recipe configs/ablation/recipes/full.yaml
    python tools/ablation.py --out runs/gpu --recipe configs/ablation/recipes/gpu.yaml \
        --seeds 0 1 2 --device cuda --workers 10

A row is a file of configs/ablation; ``--recipe`` lays another size and optimiser
over all rows. The rows that decide the paper's order have several seeds, the others
one. Every row is scored on held-out pairs at fixed numbers of samples, so that a
reader sees whether an order is significant. Started again with the same ``--out`` it
continues where it stopped: each row's state is ``OUT/ROW-seedN`` (checkpoint.pt,
log.jsonl, result.json, and at the end weights.safetensors). ``OUT/ablation.json``
is written after every score, with all rows in the folder.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from measuring import parser_of, provenance

from hybridvo.core.errors import HybridVOError, InputError
from hybridvo.core.files import write_json
from hybridvo.network.selection import SELECTION_METHODS
from hybridvo.network.weights import save_weights
from hybridvo.run.commands.stopping import StopRequest, stop_requested
from hybridvo_lab.synthetic.dataset import load_preset, read_yaml
from hybridvo_lab.training.options import load_paper_options
from hybridvo_lab.training.paper_task import PaperTask
from hybridvo_lab.training.trainer import Trainer
from hybridvo_lab.training.validation import (
    FIGURES,
    PUBLISHED_SEED,
    TrainingBatch,
    evaluate_network,
    held_out,
)

ROWS = Path(__file__).resolve().parents[1] / "configs" / "ablation"
"""Folder with a file for each row."""
DECIDING = ("pwvo-paper", "pwvo-naive", "vonet", "pwvo-uncertain")
"""Rows whose order is the paper's claim: these are trained with several seeds."""
RESULT = "result.json"
"""File with the scores of a row, in its folder."""
WITH_FLOW_LOSS = ("vonet", "vonet-attention", "pwvo-naive")
"""Rows that are also trained without the loss L^F."""
CLAIMS = (
    ("pwvo-paper", "pwvo-uncertain"),
    ("pwvo-paper", "pwvo-naive"),
    ("pwvo-paper", "vonet"),
    ("pwvo-uncertain", "pwvo-naive"),
    ("pwvo-naive", "vonet"),
    *((row, f"{row}-without-flow") for row in WITH_FLOW_LOSS),
)
"""(better, worse) in EPE according to the paper."""
MILESTONES = (6_000, 12_000, 25_000, 50_000, 100_000, 200_000, 400_000, 800_000)
"""Samples at which a row is scored, besides its end."""
PRESETS = ("data_paper", "data_diverse")
"""Presets of the held-out pairs."""


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    folder = {"type": Path, "metavar": "DIR"}
    add("--out", required=True, **folder, help="a folder for each row, and results")
    add("--configs", default=ROWS, **folder, help="the rows (configs/ablation)")
    add("--rows", help="comma-separated names (default: all)")
    recipe_help = "options laid over those of every row"
    add("--recipe", type=Path, metavar="FILE", help=recipe_help)
    seeds_help = "above 0: of the deciding rows alone"
    add("--seeds", type=int, nargs="+", default=[0], help=seeds_help)
    samples_help = "training samples of every row"
    add("--samples", type=int, default=100_000, help=samples_help)
    add("--count", type=int, default=500, help="held-out pairs of each preset")
    workers_help = "processes that draw samples (0: this one)"
    add("--workers", type=int, default=0, help=workers_help)
    add("--device", choices=("cpu", "cuda"), default="cpu")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool.

    Returns its exit code (2 bad input, 5 no output, 130 interrupted).
    """
    args = _parser().parse_args(argv)
    torch.set_num_threads(1)
    torch.backends.cudnn.benchmark = True
    # samples are small: threads inside OpenCV cost more than they give
    cv2.setNumThreads(0)
    try:
        names = chosen_rows(args)
        # the current update is finished, and a checkpoint is written
        with stop_requested() as stop:
            ablation = Ablation(args, stop)
            for seed in args.seeds:
                ablation.train(rows_of_seed(names, seed), seed)
    except HybridVOError as error:
        print(f"ablation.py: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        text = "interrupted; start it again to continue"
        print(f"ablation.py: {text}.", file=sys.stderr)
        return 130
    return 0


def chosen_rows(args: argparse.Namespace) -> list[str]:
    """Names of the rows to train."""
    files = args.configs.glob("*.yaml")
    known = sorted(path.stem for path in files if path.stem != "base")
    if args.rows is None:
        return known
    names = args.rows.split(",")
    unknown = sorted(set(names) - set(known))
    if unknown:
        raise InputError(
            f"--rows: unknown {', '.join(unknown)}; known: {', '.join(known)}."
        )
    return names


def rows_of_seed(names: Sequence[str], seed: int) -> list[str]:
    """The rows among ``names`` that are trained with a seed."""
    return [name for name in names if seed == 0 or name in DECIDING]


# --- training ---------------------------------------------------------------------


def task_of(args: argparse.Namespace, name: str, seed: int) -> PaperTask:
    """The network of a row with its data and loss."""
    changes = {} if args.recipe is None else read_yaml(args.recipe)
    recipe = load_paper_options(args.configs / f"{name}.yaml", changes)
    steps = -(-args.samples // recipe.options.batch_size)
    options = dataclasses.replace(recipe.options, seed=seed, steps=steps)
    return PaperTask(options, recipe.mixture)


class Row:
    """One row of one seed: its training, its folder and its scores."""

    def __init__(self, args: argparse.Namespace, name: str, seed: int) -> None:
        task = task_of(args, name, seed)
        options = task.options
        self.args = args
        self.name = name
        self.options = options
        self.folder = args.out / f"{name}-seed{seed}"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.trainer = Trainer(task, self.folder, args.device)
        self.trainer.resume()
        # rows with the same text get the same batches
        self.stream = json.dumps(
            [task.data, options.data_weights, options.batch_size]
        )
        self.result = self._load_result(seed)

    def _load_result(self, seed: int) -> dict[str, Any]:
        """The scores so far."""
        path = self.folder / RESULT
        if path.exists():
            return json.loads(path.read_text(encoding="utf-8"))
        parameters = sum(p.numel() for p in self.trainer.network.parameters())
        return {
            "row": self.name,
            "seed": seed,
            "parameters": parameters,
            "curve": {},
        }

    @property
    def is_done(self) -> bool:
        """Whether the training has taken all its updates."""
        return self.trainer.step == self.options.steps

    def score(self) -> bool:
        """Score the row where it is due, at its end by every rule.

        Returns whether it was due.
        """
        milestone = self._milestone()
        curve = self.result["curve"]
        if milestone is None or str(milestone) in curve:
            return False
        scores = self._scores()
        curve[str(milestone)] = scores
        write_json(self.folder / RESULT, self.result)
        self.trainer.save()
        if self.is_done:
            self._save_weights()
        short = ", ".join(f"{p} EPE {scores[p]['epe']:.3f} px" for p in PRESETS)
        name = f"{self.name} seed {self.result['seed']}"
        print(f"{name}, {milestone}: {short}", file=sys.stderr, flush=True)
        return True

    def _milestone(self) -> int | None:
        """The number of samples that the last batch has reached, if
        the row is scored there.
        """
        samples = self.trainer.samples
        batch_size = self.options.batch_size
        reached = [
            milestone
            for milestone in (*MILESTONES, self.args.samples)
            if milestone <= samples < milestone + batch_size
        ]
        return reached[-1] if reached else None

    def _scores(self) -> dict[str, Any]:
        """Figures of the exported network on the held-out pairs of each preset."""
        network = self.trainer.exported
        selection = self.options.selection
        scores: dict[str, Any] = {"seconds": round(self.trainer.elapsed_s)}
        pairs = pairs_of(self.options.data_size, self.args.count)
        for preset, batches in pairs.items():
            figures = evaluate_network(network, batches, selection)
            scores[preset] = figures
            has_uncertainty = figures["auroc_rotation"] is not None
            if not (self.is_done and has_uncertainty):
                continue
            rules = {}
            for rule in SELECTION_METHODS:
                of_rule = figures
                if rule != selection:
                    of_rule = evaluate_network(network, batches, rule)
                rules[rule] = {key: of_rule[key] for key in FIGURES}
            scores[f"rules_{preset}"] = rules
        return scores

    def _save_weights(self) -> None:
        """Write the row's weights and their card."""
        origin = provenance("ablation.py", None)
        card = {
            "row": self.name,
            "command": origin["command"],
            "commit": origin["commit"],
            **self.trainer.record,
            "curve": self.result["curve"],
        }
        path = self.folder / "weights.safetensors"
        save_weights(path, self.trainer.exported, card)


@functools.cache
def pairs_of(
    size: tuple[int, int] | None, count: int
) -> dict[str, list[TrainingBatch]]:
    """The held-out pairs of each preset in a size, drawn on first use."""
    pairs = {}
    for name in PRESETS:
        preset = load_preset(ROWS.parent / f"{name}.yaml", size)
        pairs[name] = held_out(preset, PUBLISHED_SEED, count)
    return pairs


class Ablation:
    """The training of the rows, which a signal stops."""

    def __init__(self, args: argparse.Namespace, stop: StopRequest) -> None:
        self.args = args
        self.stop = stop

    def train(self, names: Sequence[str], seed: int) -> None:
        """Train rows side by side, each from where it stopped."""
        rows = [Row(self.args, name, seed) for name in names]
        while any(not row.is_done for row in rows):
            self._advance_last(rows)
            if self.stop.number:
                for row in rows:
                    row.trainer.save()
                raise KeyboardInterrupt

    def _advance_last(self, rows: list[Row]) -> None:
        """Train the rows that are furthest behind up to the next ones."""
        behind = [row for row in rows if not row.is_done]
        step, stream = min((row.trainer.step, row.stream) for row in behind)
        group = [
            row
            for row in behind
            if (row.trainer.step, row.stream) == (step, stream)
        ]
        first = group[0]
        ahead = {row.trainer.step for row in rows if row.trainer.step > step}
        last = min({*ahead, first.options.steps})
        workers = self.args.workers
        for batch in first.trainer.task.batches(first.trainer.samples, workers):
            batch = batch.to(self.args.device)
            for row in group:
                row.trainer.advance(batch)
            was_scored = [row.score() for row in group]
            if any(was_scored):
                write_json(self.args.out / "ablation.json", summary(self.args))
            if first.trainer.step == last or self.stop.number:
                break


# --- results ----------------------------------------------------------------------


def summary(args: argparse.Namespace) -> dict[str, Any]:
    """The content of ablation.json: every curve, and the
    paper's claims as differences.
    """
    files = sorted(args.out.glob(f"*/{RESULT}"))
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in files]
    counts = sorted({int(k) for run in runs for k in run["curve"]})
    claims = []
    for preset in PRESETS:
        for samples in counts:
            for better, worse in CLAIMS:
                figures = claim(runs, better, worse, preset, str(samples))
                if figures is not None:
                    claims.append({"preset": preset, "samples": samples} | figures)
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
    """Difference in EPE of two rows over common seeds and over pairs.

    Args:
        runs: the results of all rows.
        better: the row that the paper calls better.
        worse: the other row.
        preset: the held-out pairs.
        samples: the milestone.

    Returns:
        The difference with its errors, or None where no seed has both rows.
    """
    ours = epe_by_seed(runs, better, preset, samples)
    others = epe_by_seed(runs, worse, preset, samples)
    common = [seed for seed in ours if seed in others]
    if not common:
        return None
    differences = np.array([ours[seed] - others[seed] for seed in common])
    of_seeds = differences.mean(axis=1)
    of_pairs = differences.mean(axis=0)
    std_of_seeds = None
    if len(common) > 1:
        std_of_seeds = round(float(of_seeds.std(ddof=1)), 4)
    error = of_pairs.std() / np.sqrt(of_pairs.size)
    return {
        "better": better,
        "worse": worse,
        "difference_px": round(float(of_seeds.mean()), 4),
        "spread_of_seeds_px": std_of_seeds,
        "error_over_pairs_px": round(float(error), 4),
        "as_claimed": f"{int((of_seeds < 0).sum())} of {len(common)}",
    }


def epe_by_seed(
    runs: list[dict[str, Any]], row: str, preset: str, samples: str
) -> dict[int, np.ndarray]:
    """EPE of every pair (N,), by the seed of the runs of a
    row that were scored there.
    """
    by_seed = {}
    for run in runs:
        scores = run["curve"].get(samples, {}).get(preset, {})
        if run["row"] == row and "epe_of_pairs" in scores:
            by_seed[run["seed"]] = np.array(scores["epe_of_pairs"])
    return by_seed


def without_pairs(value: Any) -> Any:
    """The figures without those of each pair."""
    if not isinstance(value, dict):
        return value
    return {k: without_pairs(v) for k, v in value.items() if k != "epe_of_pairs"}


if __name__ == "__main__":
    raise SystemExit(main())
