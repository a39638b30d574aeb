"""The paper's three tables, trained anew: every row under one budget, on the same pairs.

    python tools/ablation.py --out runs/ablation --samples 20000 --seeds 3
    python tools/ablation.py --out runs/ablation --samples 20000 --seeds 3 --sintel MPI-Sintel
    python tools/ablation.py --base configs/train_paper.yaml --samples 10000000 --out runs/full

Started again with the same ``--out`` it goes on where it was: a row that is finished is not trained
again. ``ablation.json``, ``ablation.md`` and ``ablation.png`` are written after every row, with
what is there. The published figures are of MPI Sintel with true flow and depth; ours are of
held-out synthetic pairs, and of Sintel too where ``--sintel`` names a copy.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HELD_OUT = ("data_paper.yaml", "data_wide.yaml")
"""Presets of the held-out pairs, beside the base recipe."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ablation.py", description=(__doc__ or "").splitlines()[0]
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="a folder for each row, and results")
    add("--base", type=Path, default=None, help="recipe of all rows (configs/ablation.yaml)")
    add("--samples", type=int, default=20_000, help="training samples of every row")
    add("--seeds", type=int, default=1, help="seeds of the rows that decide the order")
    add("--rows", help="comma-separated names (default: all)")
    add("--count", type=int, default=1000, help="held-out pairs of each preset")
    add("--dev", action="store_true", help="score on development pairs (seed 0), not on published")
    add("--sintel", type=Path, metavar="DIR", help="MPI Sintel as unpacked: the paper's protocol")
    add("--threads", type=int, help="threads of torch; by default torch's own choice")
    add("--workers", type=int, default=0, help="processes that draw samples (0: this one)")
    add("--keep-gb", type=float, default=0.0, help="memory for training samples kept between rows")
    add("--device", choices=("auto", "cpu", "cuda"), default="auto")
    add("--overwrite", action="store_true", help="train every row anew")
    add("-q", "--quiet", action="store_true", help="no lines of progress")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns its exit code (2 bad input, 5 no output, 130 interrupted)."""
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    from hybridvo.errors import HybridVOError, OutputError

    command = ["tools/ablation.py", *(sys.argv[1:] if argv is None else argv)]
    try:
        return _run(args, command)
    except HybridVOError as error:
        print(f"ablation.py: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    except OSError as error:
        print(f"ablation.py: {error.filename}: {error.strerror or error}", file=sys.stderr)
        return 5


def _run(args: argparse.Namespace, command: list[str]) -> int:
    import cv2
    import torch

    from hybridvo.commands.progress import interruptible
    from hybridvo.data.presets import load_preset
    from hybridvo.errors import InputError
    from hybridvo.training.ablation import KeptSamples, plan, row_options
    from hybridvo.training.held_out import PUBLISHED_SEED
    from hybridvo.training.options import load_training_options
    from hybridvo.training.provenance import source_commit

    lower = {"samples": 1, "count": 1, "threads": 1, "workers": 0, "keep_gb": 0}
    for name, least in lower.items():
        value = getattr(args, name)
        if value is not None and not value >= least:
            option = name.replace("_", "-")
            raise InputError(f"--{option}: expected {least} or more, got {value}.")
    base_file = args.base or Path(__file__).resolve().parents[1] / "configs" / "ablation.yaml"
    base, mixture = load_training_options(base_file)
    presets = {Path(n).stem: KeptSamples(load_preset(base_file.parent / n)) for n in HELD_OUT}
    todo = plan(args.seeds, None if args.rows is None else args.rows.split(","))
    if args.sintel is not None:
        from ablation_sintel import open_sintel

        open_sintel(args.sintel)  # a wrong folder is told before hours of training
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    cv2.setNumThreads(0)  # samples are small: threads inside OpenCV cost more than they give
    device = args.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    kept = KeptSamples(mixture, int(args.keep_gb * 1e9))
    seed = 0 if args.dev else PUBLISHED_SEED
    args.out.mkdir(parents=True, exist_ok=True)
    about = {
        "command": command,
        "base": base_file.name,
        "samples": args.samples,
        "held_out": {"seed": seed, "count": args.count, "presets": list(presets)},
        "commit": source_commit(),
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "cores": os.cpu_count(),
    }
    runs: list[dict[str, Any]] = []
    with interruptible() as interruption:
        for number, (row, row_seed) in enumerate(todo):
            options = row_options(base, row, row_seed, args.samples)
            if number and row_seed != todo[number - 1][1]:
                kept.forget()
            say = _Report(args.quiet, f"{number + 1}/{len(todo)} {row.name} seed {row_seed}")
            folder = args.out / f"{row.name}-seed{row_seed}"
            source = (mixture, kept)
            run = _one(args, folder, options, source, presets, seed, device, say, interruption)
            if run is None:
                print("ablation.py: interrupted; start again to go on.", file=sys.stderr)
                return 130
            runs.append({"row": row.name, "seed": row_seed, **run})
            _write(args, about, runs, None)
    sintel = None
    if args.sintel is not None:
        from ablation_sintel import score_sintel

        sintel = score_sintel(args.sintel, args.out, runs, device, args.quiet)
    for path in _write(args, about, runs, sintel):
        print(path)
    return 0


class _Report:
    """A line on stderr for every tenth entry of the log."""

    def __init__(self, quiet: bool, label: str) -> None:
        self.quiet, self.label, self.entries = quiet, label, 0

    def __call__(self, entry: dict[str, Any]) -> None:
        self.entries += 1
        if not self.quiet and self.entries % 10 == 1 and "loss" in entry:
            rate = f"{entry['samples_per_s']:.1f} samples/s"
            line = f"{self.label}: {entry['samples']} samples, loss {entry['loss']:.3f}, {rate}"
            print(line, file=sys.stderr)


def _one(
    args: argparse.Namespace,
    folder: Path,
    options: Any,
    source: tuple[Any, Any],
    presets: dict[str, Any],
    seed: int,
    device: str,
    report: _Report,
    interruption: Any,
) -> dict[str, Any] | None:
    """Train and score one row; None if the training was interrupted."""
    from hybridvo.files import atomic_write
    from hybridvo.training.ablation import score_row, train_row

    results = folder / "result.json"
    if args.overwrite:
        for name in ("checkpoint.pt", "options.json", "log.jsonl", "result.json"):
            (folder / name).unlink(missing_ok=True)
    mixture, kept = source
    trainer = train_row(
        options, mixture, folder, device, args.workers, kept, report, interruption.is_set
    )
    if trainer.step < options.steps:
        return None
    asked = {"seed": seed, "count": args.count}
    run = _read(results)
    if run is None or run.get("asked") != asked or run.get("updates") != trainer.step:
        started = time.perf_counter()
        scores = score_row(trainer.exported, presets, seed, args.count, options)
        run = {
            "asked": asked,
            "updates": trainer.step,
            "samples": trainer.samples,
            "skipped": trainer.skipped,
            "seconds": trainer.elapsed_s,
            "samples_per_s": trainer.samples / max(trainer.elapsed_s, 1e-9),
            "parameters": sum(p.numel() for p in trainer.network.parameters()),
            "scores": scores,
        }
        with atomic_write(results) as file:
            json.dump(run, file, indent=1)
        if not report.quiet:
            epe = ", ".join(f"{name} {score['epe']:.3f}" for name, score in scores.items())
            seconds = time.perf_counter() - started
            print(f"{report.label}: EPE {epe} px (scored in {seconds:.0f} s)", file=sys.stderr)
    return run


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _write(
    args: argparse.Namespace,
    about: dict[str, Any],
    runs: list[dict[str, Any]],
    sintel: dict[str, Any] | None,
) -> list[Path]:
    """The three files, from what there is so far."""
    from ablation_report import markdown, plot, summary

    from hybridvo.files import atomic_write

    result = {**about, **summary(runs, sintel, args.seeds)}
    paths = [args.out / f"ablation.{kind}" for kind in ("json", "md", "png")]
    with atomic_write(paths[0]) as file:
        file.write(json.dumps(result, indent=1, allow_nan=False) + "\n")
    with atomic_write(paths[1]) as file:
        file.write(markdown(result))
    plot(result, paths[2])
    return paths


if __name__ == "__main__":
    raise SystemExit(main())
