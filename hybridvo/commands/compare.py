"""``hybridvo compare`` and ``demo``: methods side by side, each as a ``hybridvo run``."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import re
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from hybridvo.commands.doubts import doubts_in_words
from hybridvo.commands.run import flow_provider, frames_of, run, weights_hash
from hybridvo.data.lists import abbreviated
from hybridvo.data.open import open_sequence
from hybridvo.data.sequence import Sequence
from hybridvo.errors import HybridVOError, InputError, OutputError
from hybridvo.evaluation import scores
from hybridvo.evaluation.report import write_report
from hybridvo.files import (
    LOCK,
    Mode,
    atomic_write,
    locked_folder,
    make_folder,
    provenance,
    write_json,
)
from hybridvo.network.models import Models
from hybridvo.options import FlowOptions, Options
from hybridvo.pipeline import METHODS, check_method
from hybridvo.synthetic.render import write_sintel
from hybridvo.synthetic.scenes import make_scene

_logger = logging.getLogger(__name__)
WRITTEN = (
    *("results.json", "results.csv", "pairs.csv"),
    *("report.md", "report.html", "report.tex"),
)
"""The files that a finished comparison leaves beside ``runs/``."""
DEMO = {
    "hybrid": "hybridvo (hybrid)",
    "classical": "hybridvo (classical)",
    "pnp-ransac": "OpenCV PnP-RANSAC",
    "pnp-ransac-tuned": "OpenCV PnP-RANSAC, tuned",
    "identity": "identity (no motion)",
}
"""The methods of the demo, and what its table calls them."""


def compare(
    sequences: Iterable[str | Path],
    out: str | Path,
    *,
    methods: Iterable[str] = ("all",),
    options: Options | None = None,
    dataset: str | None = None,
    camera: str | None = None,
    depth_scale: float | None = None,
    mask: str | None = None,
    protocol: Literal["paper"] | None = None,
    models: Models | None = None,
    mode: Mode = "new",
    command: Iterable[str] = (),
    quiet: bool = True,
) -> dict[str, Any]:
    """Run every method on every sequence, and write the results; returns a summary, JSON-ready.

    A folder in ``sequences`` stands for all sequences in it, the method ``all`` for every method
    that can run here; ``dataset`` to ``mask`` are as in ``open_sequence``, for all of them.
    """
    out = Path(out)
    options = options or Options()
    models = models or Models(options.run.device)
    names, missing = methods_to_run(methods)
    opened = _open_each(sequences, options, dataset, camera, depth_scale, mask)
    if protocol is not None:
        scores.check_protocol(opened)
    present = [name for name in (*WRITTEN, "runs") if (out / name).exists()]
    if present and mode == "new":
        choices = "--resume to go on, --overwrite to replace them, or another --out"
        raise InputError(f"{out}: holds {', '.join(present)}; pass {choices}.")
    given: dict[str, Any] = {
        "models": models,
        "command": list(command),
        "quiet": quiet,
    }
    given |= {"mode": "resume", "picture": False}
    with locked_folder(out):
        if mode == "overwrite":
            shutil.rmtree(out / "runs", ignore_errors=True)
            if os.path.lexists(out / "runs"):
                raise OutputError(f"{out / 'runs'}: cannot be replaced.")
        for name, reason in missing.items():
            _logger.warning("not run: %s: %s", name, reason)
        shared = out, names, options, given, missing, protocol
        scored = [_score(sequence, *shared) for sequence in opened]
        table = scores.pair_table(
            [pair for pairs, _, _ in scored for pair in pairs]
        )
        rows = [row for _, some, _ in scored for row in some]
        facts = [fact for _, _, fact in scored]
        totals = [
            scores.total_row(
                pairs, [r for r in rows if (r["method"], r["flow_source"]) == key]
            )
            for key, pairs in table.groupby(["method", "flow_source"], sort=False)
        ]
        result: dict[str, Any] = {
            "command": list(command),
            **provenance(),
            "options": dataclasses.asdict(options),
            "weights": {name: weights_hash(name, models) for name in names},
            "missing": missing,
            "rows": rows,
            "totals": totals,
            "sequences": facts,
            "protocol": None
            if protocol is None
            else scores.protocol_summary(facts),
        }
        _write(out, result, table)
    if not rows:
        raise RuntimeError(f"every method failed; {out / 'report.md'} says how.")
    return {
        "totals": totals,
        "missing": missing,
        "files": [str(out / name) for name in WRITTEN],
    }


def _write(out: Path, result: dict[str, Any], pairs: pd.DataFrame) -> None:
    """Write what a finished comparison leaves beside its runs."""
    write_json(out / "results.json", result)
    lines = pd.DataFrame(result["rows"], dtype=object).drop(
        columns="reasons", errors="ignore"
    )
    for name, data in (("results.csv", lines), ("pairs.csv", pairs)):
        with atomic_write(out / name) as file:
            data.to_csv(file, index=False, lineterminator="\n")
    write_report(out, result, pairs)


def methods_to_run(names: Iterable[str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the methods to run, and why ``all`` leaves some out, with the remedy."""
    is_all = list(names) == ["all"]
    missing: dict[str, str] = {}
    ready: dict[str, None] = {}
    for name in METHODS if is_all else names:
        try:
            ready[check_method(name)] = None
        except InputError as error:
            if not is_all:
                raise
            missing[name] = str(error)
    return tuple(ready), missing


def open_all(path: str | Path, *how: Any) -> list[Sequence]:
    """Open the sequence in a folder, or all one level below it (MPI Sintel: of its final pass).

    ``how`` are the further arguments of ``open_sequence``.
    """
    try:
        return [open_sequence(path, *how)]
    except HybridVOError:
        inner = Path(path)
        found = []
        for names in (("training",), ("final", "clean")):
            inner = next(
                (inner / name for name in names if (inner / name).is_dir()), inner
            )
        for child in sorted(inner.iterdir()) if inner.is_dir() else ():
            with contextlib.suppress(HybridVOError):
                found += [open_sequence(child, *how)] if child.is_dir() else []
        if not found:
            raise
        return found


def _open_each(
    paths: Iterable[str | Path], options: Options, *how: Any
) -> list[Sequence]:
    """Open all sequences, each with a name of its own; refuse at once what cannot be run."""
    found: list[Sequence] = []
    for sequence in (
        sequence for path in paths for sequence in open_all(path, *how)
    ):
        frames_of(sequence, options, at_least=2)
        flow_provider(sequence, options)
        own = sequence.name
        count = 1
        while sequence.name in (other.name for other in found):
            count += 1
            sequence.name = f"{own}_{count}"
        found.append(sequence)
    if not found:
        raise InputError(
            "compare: expected at least one folder of a sequence, got none."
        )
    return found


def _score(
    sequence: Sequence,
    out: Path,
    methods: Iterable[str],
    options: Options,
    given: dict[str, Any],
    missing: dict[str, str],
    protocol: str | None,
) -> tuple[list[Any], list[dict[str, Any]], dict[str, Any]]:
    """Run the methods on a sequence; returns its pairs, a line for each method, facts about it."""
    name = sequence.name
    flow = flow_provider(sequence, options)[1]
    folder = "runs/" + re.sub(r"[^\w.-]", "_", name)
    metrics = {}
    motions = []
    left_out = []
    facts = []
    for method in methods:
        asked = replace(
            options, run=replace(options.run, method=method, max_failed=1.0)
        )
        try:
            metrics[method] = run(sequence, out / folder / method, asked, **given)[
                0
            ]["metrics"]
            motions.append(_motions(out / folder / method, options.run.stride))
        except HybridVOError:
            raise
        except Exception as error:  # a bug of one method costs its run
            missing[f"{method} on {name}"] = f"{type(error).__name__}: {error}"
            _logger.exception("%s on %s", method, name)
    table = (
        pd.concat(motions)
        if motions
        else pd.DataFrame(columns=["index", "next", "missing"])
    )
    # each pair is looked at once, whichever methods estimated it
    for row in table.drop_duplicates("next").itertuples():
        pair: Any = (row.prev, row.next)
        if protocol is not None and not scores.same_intrinsics(
            *map(sequence.camera, pair)
        ):
            left_out.append({"index": row.prev, "reason": "the intrinsics change"})
            table = table[table["next"] != row.next]
        elif row.missing:
            left_out.append(
                {"index": row.next, "reason": f"cannot be read: {row.message}"}
            )
        else:
            facts.append({"next": row.next} | scores.pair_facts(sequence, *pair))
    table = table.merge(
        pd.DataFrame(facts, columns=["next", *scores.FACTORS]), "left", "next"
    )
    table = table.assign(sequence=name, flow_source=flow).sort_values(
        "index", kind="stable"
    )
    table = scores.pair_table(table)
    gt = scores.true_trajectory(sequence, frames_of(sequence, options))
    if gt is not None:
        make_folder(out / folder)  # where every method fails before it has one
        gt.save(out / folder / "ground_truth.tum")
    about = {"flow_source": flow, "depth_source": sequence.depth_source}
    rows = []
    for method, path in metrics.items():
        named = {"sequence": name, "method": method, **about}
        row = scores.sequence_row(table[table["method"] == method], path, named)
        rows.append(row | {"trajectory": f"{folder}/{method}/trajectory.tum"})
    fact = {
        "name": name,
        "path": str(sequence.root),
        **about,
        "pairs_scored": table["next"].nunique(),
        "left_out": left_out,
        "warnings": list(sequence.warnings),
        "ground_truth": gt and f"{folder}/ground_truth.tum",
    }
    return table.to_dict("records"), rows, fact


def _motions(folder: Path, stride: int) -> pd.DataFrame:
    """The motions of a run, with the columns of a table of pairs."""
    texts = {"reason": str, "message": str}
    # of a name, pandas expands a "~"
    with open(folder / "steps.csv", encoding="utf-8") as file:
        steps = pd.read_csv(file, dtype=texts)
    steps = steps[steps["prev_index"].notna()].fillna({"reason": "", "message": ""})
    missing = steps["reason"] == "missing_frame"
    steps.loc[missing, [*scores.ERRORS, "motion_ms", "flow_ms"]] = np.nan
    return steps.assign(
        method=folder.name,
        status=steps["status"]
        + steps["reason"].map(lambda why: f"({why})" if why else ""),
        ms=steps["motion_ms"],
        prev=steps["prev_index"].astype(int),
        next=steps["index"],
        index=steps["index"] - stride,
        missing=missing,
    )


def demo(
    out: str | Path,
    *,
    frames: int = 20,
    seed: int = 0,
    overwrite: bool = False,
    command: Iterable[str] = (),
    quiet: bool = False,
) -> dict[str, Any]:
    """Render a scene into ``out/data`` and compare methods on it; returns a summary, JSON-ready.

    They are given OpenCV's DIS flow and the true depth.
    """
    if frames < 2:
        raise InputError(f"demo: expected at least 2 frames, got {frames}.")
    out = Path(out)
    name = f"light_{seed}_{frames}"
    present = {path.name for path in out.glob("*")}
    if present and not (
        overwrite and {"data"} <= present <= {"data", "runs", LOCK, *WRITTEN}
    ):
        choices = (
            "--overwrite to replace what a demo has written alone, or another --out"
        )
        raise InputError(
            f"{out}: holds {abbreviated(sorted(present))}; pass {choices}."
        )
    scene = make_scene("light", seed, height=218, width=512, frames=frames)
    write_sintel(scene, out / "data", name)
    compare(
        [out / "data" / "training" / "clean" / name],
        out,
        methods=tuple(DEMO),
        options=Options(flow=FlowOptions(source="dis")),
        mode="overwrite" if overwrite else "new",
        command=command,
        quiet=quiet,
    )
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    with open(out / "pairs.csv", encoding="utf-8") as file:
        pairs = pd.read_csv(file)
    doubts = []
    for method in ("hybrid", "classical"):  # the others know of no doubt
        statuses = pairs[pairs["method"] == method]["status"]
        outcomes = statuses.str.extract(r"(\w+)(?:\((\w+)\))?").fillna("")
        sentences = doubts_in_words(outcomes.itertuples(index=False))
        doubts += [f"{DEMO[method]}: {sentence}" for sentence in sentences]
    moving = [(scene.object_id(i) > 0).mean() for i in range(frames)]
    return {
        "scene": {
            "kind": "light",
            "seed": seed,
            "frames": frames,
            "height": 218,
            "width": 512,
        },
        "moving_fraction": float(np.median(moving)),
        "rows": [
            {
                "method": DEMO[row["method"]],
                "ate_cm": 100.0 * row["ate_rmse_origin"],
                "rotation_deg": row["rot_err_deg_mean"],
                "epe_px": row["epe_l2_px"],
                "failed": row["failed"],
                "degraded": row["degraded"],
                "frame_ms": row["ms_per_pair_median"] + row["flow_ms_median"],
            }
            for row in results["rows"]
        ],
        "doubts": doubts,
        "report": str(out / "report.html"),
    }
