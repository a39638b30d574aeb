"""The tables of the README and of docs/results.md, from docs/results, and the README's picture.

    python tools/make_docs.py                              # fill README.md, write docs/results.md
    python tools/make_docs.py --check                      # exit code 1 if they are not up to date
    python tools/make_docs.py --figure docs/teaser.png     # draw the picture anew

In the README, what stands between ``<!-- table:NAME -->`` and ``<!-- end:NAME -->`` is made here.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measuring import ROOT

PART = re.compile(r"(<!-- table:(\w+) -->\n)(.*?)(<!-- end:\2 -->)", re.DOTALL)
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#222222"
"""Okabe and Ito: told apart by colour-blind readers."""
FAILURES = "[n]: pairs that are wrong by more than a pixel, or without an answer"

Results = dict[str, dict[str, Any]]


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make_docs.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results.md")
    parser.add_argument("--results", type=Path, default=ROOT / "docs" / "results", metavar="DIR")
    parser.add_argument("--check", action="store_true", help="write nothing, only compare")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw the README's picture")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.figure is not None:
        args.figure.write_bytes(draw(track("heavy_two", seed=0, shown=9)))
        return 0
    results = read(args.results)
    stale = 0
    for path, text in (
        (args.readme, fill(args.readme.read_text(encoding="utf-8"), results)),
        (args.page, page(results)),
    ):
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        stale += 1
        if args.check:
            print(f"{path}: differs from {args.results}", file=sys.stderr)
        else:
            path.write_text(text, encoding="utf-8")
            print(path)
    return int(args.check and stale > 0)


def read(folder: Path) -> Results:
    """Every JSON file of the folder by its stem."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))
        for path in sorted(folder.glob("*.json"))
    }


def fill(text: str, results: Results) -> str:
    """The text with every marked part made anew; empty where its figures are missing."""

    def part(match: re.Match[str]) -> str:
        lines = TABLES[match.group(2)](results)
        return match.group(1) + ("\n" + "\n".join(lines) + "\n\n" if lines else "") + match.group(4)

    return PART.sub(part, text)


def page(results: Results) -> str:
    """docs/results.md: a title and a table for each kind of measurement."""
    lines = [
        "# Results",
        "",
        "Made by `python tools/make_docs.py` from the JSON files in `docs/results`. Ground truth "
        "that a method is given (true flow, true depth, a true mask) is named: an oracle. "
        f"{FAILURES}. Times are wall times on a shared machine.",
        "",
    ]
    for title, name in PAGE:
        table_lines = TABLES[name](results)
        if table_lines:
            lines += [f"## {title}", "", *table_lines, ""]
    return "\n".join(lines).rstrip() + "\n"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table, names left and numbers right."""
    ruler = "|---" * 1 + "|---:" * (len(header) - 1) + "|"
    return [line(header), ruler, *map(line, rows)]


def line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def number(value: float | None) -> str:
    """Three significant digits; a dash where there is none."""
    if value is None:
        return "-"
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def error(row: dict[str, Any]) -> str:
    """Median error in px, with the number of failures."""
    count = row["failures"]["count"]
    return number(row["epe_px"]["median"]) + (f" [{count}]" if count else "")


def source(content: dict[str, Any]) -> str:
    """Where figures come from."""
    machine = content["machine"]
    return (
        f"`{content['command']}`, commit `{content['commit']}`; {machine['processor']}, "
        f"{machine['cores']} cores."
    )


def heavy(results: Results) -> list[str]:
    """Scenes in which most of the image moves: median error in px, and failures."""
    content = results.get("benchmark", {})
    if "heavy" not in content:
        return []
    part = content["heavy"]
    kinds = [kind for kind in part["summary"] if kind != "total"]
    rows = []
    for flow in ("dis", "true"):
        total = part["summary"]["total"][flow]
        for method, row in total.items():
            cells = [error(part["summary"][kind][flow][method]) for kind in kinds]
            share = f"{100 * row['failures']['count'] / row['pairs']:.0f} %"
            rows.append([f"`{method}`, {flow} flow", *cells, share, number(row["ms"])])
    height, width = part["size"]
    return [
        *table(["method", *kinds, "failures", "ms"], rows),
        "",
        f"Median error of the ego flow, px; seeds {part['seeds'][0]} to {part['seeds'][1]} of each "
        f"kind, {width}x{height}, depth {part['depth']}. True flow is an oracle. {source(content)}",
    ]


def peers(results: Results) -> list[str]:
    """The README's one table: every method on estimated flow."""
    content = results.get("benchmark", {})
    if "heavy" not in content:
        return []
    rows = []
    for method, row in content["heavy"]["summary"]["total"]["dis"].items():
        if "oracle" in method:
            continue
        share = f"{100 * row['failures']['count'] / row['pairs']:.0f} %"
        rows.append(
            [f"`{method}`", number(row["epe_px"]["median"]), number(row["translation_cm"]),
             number(row["rotation_deg"]), share, number(row["ms"])]
        )  # fmt: skip
    part = content["heavy"]
    pairs = part["summary"]["total"]["dis"][next(iter(part["summary"]["total"]["dis"]))]["pairs"]
    return [
        *table(["method", "error, px", "cm", "deg", "wrong by more than 1 px", "ms a pair"], rows),
        "",
        f"Medians over {pairs} pairs of rendered scenes in which most of the image moves; flow: "
        f"OpenCV DIS, depth {part['depth']}; flow not in the time. {source(content)}",
    ]


def scenarios(results: Results) -> list[str]:
    """Pairs with known noise: median error in px of every method in every scenario."""
    content = results.get("benchmark", {})
    if "scenarios" not in content:
        return []
    part = content["scenarios"]
    names = list(part["summary"])
    methods = list(part["summary"][names[0]])
    rows = [[name, *(error(part["summary"][name][method]) for method in methods)] for name in names]
    means = [number(part["geometric_mean_px"][method]) for method in methods]
    rows.append([f"geometric mean of the first {len(part['main'])}", *means])
    lines = [
        *table(["scenario", *(f"`{method}`" for method in methods)], rows),
        "",
        f"Median error of the ego flow, px; seeds {part['seeds'][0]} to {part['seeds'][1]}. "
        f"{source(content)}",
    ]
    if "model_noise" in content:
        row = content["model_noise"]["refine"]
        lines += [
            "",
            f"Covariance of `refine` under the noise that it assumes: mean normalised error "
            f"{row['nees_mean']:.2f} +- {row['nees_standard_error']:.2f} over {row['pairs']} pairs "
            f"(right: 6), {row['overconfident']} outside of 3 sigma (right: 0.3 %).",
        ]
    return lines


def real(results: Results) -> list[str]:
    """Recorded sequences: medians over the pairs, and the error at the end of the chain."""
    content = results.get("benchmark", {})
    if "real" not in content:
        return []
    rows = []
    for name, sequence in content["real"]["summary"].items():
        for flow, by_method in sequence["flows"].items():
            for k, (method, row) in enumerate(by_method.items()):
                first = f"{name}, {flow}" if k == 0 else ""
                keys = ("rotation_deg", "translation_cm")
                ends = ("end_rotation_deg", "end_translation_cm", "ms")
                values = [*(number(row[key]) for key in keys), error(row)]
                values += [number(row[key]) for key in ends]
                rows.append([first, f"`{method}`", *values])
    header = ["sequence, flow", "method", "deg", "cm", "px", "end, deg", "end, cm", "ms"]
    return [*table(header, rows), "", f"Medians over the pairs. {source(content)}"]


def sequences(results: Results) -> list[str]:
    """Paths of whole rendered sequences, and how often the stated probability comes true."""
    content = results.get("sequences")
    if content is None:
        return []
    kinds = content["kinds"]
    rows = []
    for flow, by_method in content["paths"].items():
        for method, by_kind in by_method.items():
            cells = [number(by_kind[kind]["rmse_cm"]) for kind in kinds]
            pairs = content["pairs"][flow][method]
            count = f"{pairs['failures']['count']} of {pairs['pairs']}"
            rows.append([f"`{method}`, {flow} flow", *cells, count, number(pairs["nees_median"])])
    lines = [
        *table(["method", *kinds, "failed pairs", "median NEES"], rows),
        "",
        f"Root mean square error of the position, cm, both paths from the same first pose; "
        f"{content['frames']} frames a sequence, depth {content['depth']}; the NEES of a right "
        f"covariance has the median 5.35. {source(content)}",
    ]
    stated = content["probability"]["dis"].get("hybrid")
    if stated:
        bins = "; ".join(
            f"{row['from']:g} to {row['to']:g}: {row['count']} of {row['of']}"
            for row in stated["bins"]
        )
        lines += [
            "",
            f"Probability that `hybrid` states, DIS flow, and how many of these motions are right "
            f"within a pixel: {bins}. Flagged: {stated['failures_flagged']} of "
            f"{stated['failures']} failures, and {stated['right_flagged']} right motions.",
        ]
    return lines


def costs(results: Results) -> list[str]:
    """Wall time of a pair and of a whole frame, memory, batches."""
    content = results.get("benchmark", {})
    if "costs" not in content:
        return []
    part = content["costs"]
    sizes = list(part["pair_ms"])
    rows = [
        [f"`{method}`", *(number(part[key][size][method]) for key in ("pair_ms", "frame_ms")
         for size in sizes), number(part["memory_mib"][method])]
        for method in part["pair_ms"][sizes[0]]
    ]  # fmt: skip
    header = [f"pair, {size}" for size in sizes] + [f"frame, {size}" for size in sizes]
    first = part["first_call"]
    batch = ", ".join(f"{row['pairs']}: {row['pairs_per_s']:g}/s" for row in part["batch"])
    return [
        *table(["method", *header, "MiB"], rows),
        "",
        "Milliseconds of an estimate with the flow given, and of a tracked frame with its flow "
        f"(OpenCV DIS). MiB: most that one estimate allocates at {sizes[-1]}. Import and first "
        f"call: {number(first.get('import_s'))} s and {number(first.get('warm_up_s'))} s. Batched "
        f"refinement of 256x128 on the CPU, pairs a batch: {batch}. {source(content)}",
    ]


TABLES: dict[str, Callable[[Results], list[str]]] = {
    "peers": peers,
    "heavy": heavy,
    "scenarios": scenarios,
    "real": real,
    "sequences": sequences,
    "costs": costs,
}
PAGE = (
    ("Most of the image moves", "heavy"),
    ("Known noise", "scenarios"),
    ("Recorded sequences", "real"),
    ("Whole sequences", "sequences"),
    ("Time and memory", "costs"),
)


def track(kind: str, seed: int, shown: int) -> dict[str, Any]:
    """Two methods over a scene, and the inputs and weights of one pair."""
    from hybridvo import Odometry
    from hybridvo.flow import dis_flow
    from hybridvo.synthetic.render import SyntheticSequence, make_scene

    scene = make_scene(kind, seed, height=218, width=512)
    sequence, flow = SyntheticSequence(scene), dis_flow()
    trackers = {name: Odometry(method=name) for name in ("hybrid", "pnp-ransac")}
    paths: dict[str, list[np.ndarray]] = {name: [] for name in trackers}
    prev, result = None, {}
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        field = None if prev is None else flow(prev, frame)
        for name, tracker in trackers.items():
            step = tracker.track(frame, field)
            paths[name].append(step.T_world_cam[:3, 3])
            if prev is not None and prev.index == shown and name == "hybrid":
                result = {"rgb": prev.rgb, "flow": field.flow, "weights": step.motion.weights}
        prev = frame
    moving = [float(sequence.moving(i).mean()) for i in range(len(sequence))]
    return result | {
        "mover": sequence.moving(shown),
        "paths": {name: np.array(path) for name, path in paths.items()},
        "truth": (np.linalg.inv(sequence.poses[0]) @ sequence.poses)[:, :3, 3],
        "share": float(np.median(moving)),
    }


def flow_colours(flow: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: hue is the direction, saturation the length up to its 99th percentile."""
    import cv2

    length = np.linalg.norm(flow, axis=2)
    hue = (np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360).astype(np.float32)
    saturation = np.clip(length / max(np.percentile(length, 99), 1e-6), 0, 1).astype(np.float32)
    hsv = np.dstack([hue, saturation, np.ones_like(saturation)])
    return (255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)).astype(np.uint8)


def draw(drawn: dict[str, Any]) -> bytes:
    """PNG of the four panels, from left to right."""
    import io

    import cv2
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.8, 3.25), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1.62, 1.12))
    places = [grid[0, 0], grid[1, 0], grid[:, 1]]
    height, width = drawn["rgb"].shape[:2]
    weights = cv2.resize(drawn["weights"], (width, height), interpolation=cv2.INTER_NEAREST)
    panels = {
        f"image ({100 * drawn['share']:.0f} % of it moves by itself)": drawn["rgb"],
        "optical flow (OpenCV DIS)": flow_colours(drawn["flow"]),
        "weight of each pixel in the camera motion (white outline: what truly moves)": weights,
    }
    for place, (title, image) in zip(places, panels.items(), strict=True):
        panel = figure.add_subplot(place)
        panel.imshow(image, cmap="magma", vmin=0, vmax=1 if image.ndim == 2 else None)
        panel.set_title(title, fontsize=9.5, loc="left")
        panel.set_xticks([])
        panel.set_yticks([])
    panel.contour(drawn["mover"], levels=[0.5], colors="white", linewidths=0.8)
    draw_paths(figure.add_subplot(grid[:, 2]), drawn)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def draw_paths(panel: Any, drawn: dict[str, Any]) -> None:
    """Paths seen from above."""
    for path, colour, style, width, name in (
        (drawn["truth"], GREY, "-", 4.0, "ground truth"),
        (drawn["paths"]["pnp-ransac"], ORANGE, "--", 1.8, "OpenCV PnP-RANSAC"),
        (drawn["paths"]["hybrid"], BLUE, "-", 1.8, "hybridvo"),
    ):
        rmse = 100 * np.sqrt(np.mean(np.sum((path - drawn["truth"]) ** 2, axis=1)))
        given = name == "ground truth"
        label = name if given else f"{name}: RMSE {number(float(rmse))} cm"
        panel.plot(path[:, 0], path[:, 2], style, color=colour, lw=width, label=label,
                   alpha=0.3 if given else 1.0)  # fmt: skip
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_title("camera path from above, metres", fontsize=9.5, loc="left")
    panel.tick_params(labelsize=8)
    panel.grid(True, color="#e4e4e4", linewidth=0.8)
    low, high = panel.get_ylim()
    panel.plot(0, high + 0.4 * (high - low), alpha=0)  # room for the legend
    panel.legend(fontsize=8.5, frameon=False, loc="upper left")


if __name__ == "__main__":
    sys.exit(main())
