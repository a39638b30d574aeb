"""What each learned part of the hybrid gives, on rendered sequences in which most of it moves.

    python tools/ablation_hybrid.py --seed0 8000 --sequences 6 --out runs/ablation_hybrid

Rows, each with one part more than the one before: the classical refinement with its hand-made cues;
the judge's first look; its second look; PWVO as it was after each stage of its training (the
paper's losses, the doubt through the fit), where the weights of those stages are handed in; PWVO as
shipped. Beside them the fit in the true mask, an oracle. Writes JSON and Markdown.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ORACLE = "fit in the true mask (oracle)"


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ablation_hybrid.py", description=(__doc__ or "").splitlines()[0]
    )
    add = parser.add_argument
    add("--sequences", type=int, default=6, help="of each kind of scene")
    add("--seed0", type=int, default=0, help="first seed; 0-999 are for development")
    add("--pwvo-paper", type=Path, metavar="FILE", help="PWVO trained by the paper's losses only")
    add("--pwvo-fit", type=Path, metavar="FILE", help="PWVO trained through the fit as well")
    add("--judge", default="judge", help="name of shipped weights, or a file")
    add("--pwvo", default="pwvo", help="name of shipped weights, or a file")
    add("--flow", choices=("true", "dis", "both"), default="both")
    add("--out", type=Path, required=True, metavar="DIR")
    add("--overwrite", action="store_true", help="replace what is in --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import HybridVOError, OutputError
    from hybridvo.evaluation.report import write_json
    from hybridvo.training.provenance import source_commit

    target = args.out / "ablation_hybrid.json"
    if target.exists() and not args.overwrite:
        print(f"ablation_hybrid.py: {target} exists; pass --overwrite.", file=sys.stderr)
        return 2
    if args.sequences < 1 or args.seed0 < 0:
        print("ablation_hybrid.py: expected --sequences >= 1 and --seed0 >= 0.", file=sys.stderr)
        return 2
    try:
        stages = {"the paper's losses": args.pwvo_paper, "through the fit": args.pwvo_fit}
        rows = systems(args.judge, args.pwvo, stages)
        records = measure(rows, args.seed0, args.sequences, args.flow)
        result = {
            "command": "python tools/ablation_hybrid.py "
            + shlex.join(sys.argv[1:] if argv is None else argv),
            "commit": source_commit(),
            "summary": summarise(records, list(rows)),
            "pairs": records,
        }
        args.out.mkdir(parents=True, exist_ok=True)
        write_json(target, result)
        page = markdown(result)
        target.with_suffix(".md").write_text(page, encoding="utf-8")
    except OSError as error:
        print(f"ablation_hybrid.py: {args.out}: {error.strerror or error}.", file=sys.stderr)
        return 5
    except HybridVOError as error:
        print(f"ablation_hybrid.py: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    print(page)
    return 0


def systems(
    judge: str, pwvo: str, stages: dict[str, Path | None]
) -> dict[str, Callable[[Any, dict[str, Any]], Any]]:
    """The rows: called with a pair and, for the oracle alone, its truth."""
    from hybridvo.learned_judge import LearnedJudge

    from hybridvo.network.weights import load_weights, pretrained
    from hybridvo.pipeline import refine

    class FirstLook(LearnedJudge):
        """Scores alone: no mask, no second fit."""

        def first_look(self, grid: Any, motions: Any, expected: Any, masks: int) -> Any:
            return super().first_look(grid, motions, expected, 0)

    def read(name: str | Path) -> Any:
        path = Path(name) if Path(name).is_file() else pretrained(str(name))
        return load_weights(path)[0].eval()

    network = read(judge)
    judges = {
        "+ judge, one look": FirstLook(network),
        "+ second look": LearnedJudge(network),
    }
    for stage, path in stages.items():
        if path is not None:
            judges[f"+ PWVO, {stage}"] = LearnedJudge(network, read(path))
    judges["+ PWVO as shipped"] = LearnedJudge(network, read(pwvo))
    rows: dict[str, Callable[[Any, dict[str, Any]], Any]] = {
        "refinement, hand-made cues": lambda pair, truth: refine(pair)
    }
    for name, which in judges.items():
        rows[name] = lambda pair, truth, which=which: refine(pair, judge=which)
    rows[ORACLE] = lambda pair, truth: refine(pair, weights=truth["static"])
    return rows


def measure(
    rows: dict[str, Callable[[Any, dict[str, Any]], Any]], seed0: int, sequences: int, flows: str
) -> list[dict[str, Any]]:
    """One record per pair and row."""
    from benchmark_heavy import KINDS, heavy_pairs
    from benchmark_scores import epe

    from hybridvo.pipeline import warm_up

    warm_up()
    records = []
    for kind in KINDS:
        for seed in range(seed0, seed0 + sequences):
            for index, flow, pair, truth in heavy_pairs(kind, seed):
                if flows not in ("both", flow):
                    continue
                for name, system in rows.items():
                    started = time.thread_time()
                    answer = system(pair, truth)
                    ms = 1e3 * (time.thread_time() - started)
                    error = epe(answer.T_curr_prev, pair, truth)
                    records.append(
                        {
                            **{"kind": kind, "seed": seed, "index": index, "flow": flow},
                            **{"system": name, "epe_px": float(error), "cpu_ms": ms},
                            "failed": not (answer.ok and error <= 1.0),
                            "status": answer.status.state.value,
                        }
                    )
        print(f"{kind}: {len(records)} answers", file=sys.stderr)
    return records


def summarise(records: list[dict[str, Any]], names: list[str]) -> list[dict[str, Any]]:
    """Failures (EPE above 1 px, or no estimate), errors and time, by flow and system."""
    table = []
    for flow in ("true", "dis"):
        for name in names:
            mine = [r for r in records if r["flow"] == flow and r["system"] == name]
            if not mine:
                continue
            failed = [r for r in mine if r["failed"]]
            table.append(
                {
                    "flow": flow,
                    "system": name,
                    "pairs": len(mine),
                    "failures": len(failed),
                    "failures_said": sum(r["status"] != "ok" for r in failed),
                    "median_epe_px": float(np.median([r["epe_px"] for r in mine])),
                    "q90_epe_px": float(np.quantile([r["epe_px"] for r in mine], 0.9)),
                    "median_cpu_ms": float(np.median([r["cpu_ms"] for r in mine])),
                }
            )
    return table


def markdown(result: dict[str, Any]) -> str:
    """The table, with the command above it."""
    lines = [
        f"`{result['command']}`",
        "",
        "| flow | system | pairs | failures (EPE > 1 px) | of them not ok | median EPE, px "
        "| 90 %, px | CPU ms |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in result["summary"]:
        lines.append(
            f"| {r['flow']} | {r['system']} | {r['pairs']} | {r['failures']} "
            f"| {r['failures_said']} | {r['median_epe_px']:.3f} | {r['q90_epe_px']:.2f} "
            f"| {r['median_cpu_ms']:.0f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
