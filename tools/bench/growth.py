"""The benchmark's cost as work grows: image size, moving objects, hypotheses, frames, sequences.

    python tools/benchmark.py growth FOLDER --hypotheses 8 --marks 10    # one case, as JSON

Every case is tracked by a process of its own, which reads the frames that were rendered before:
the largest memory that was resident is that of a program which tracks such frames, libraries and
networks included. A long run goes to and fro over a short recording.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from known_pairs import rendered
from matplotlib.figure import Figure
from measuring import digits, parser_of, this_tool, timed

from bench import scale
from hybridvo import Camera, Frame

METHOD = "hybrid"
SIZES = ((240, 320), (480, 640), (436, 1024), (720, 1280), (1080, 1920))
"""Rows and columns of the images."""
SIZE = (480, 640)
"""Those of the other cases."""
FRAMES = 8
"""Frames of a rendered case; the first two do not count."""
FIRST = 2
GROWN_KIND = "light"
"""The scene whose size grows."""
MOVING = ("static", "light", "heavy_rigid")
"""Scenes in which nothing, 30 % and 60 % of the image moves."""
MANY_KIND = "heavy_ten"
"""The scene of many motions, in which hypotheses are limited."""
HYPOTHESES = (1, 4, 8, 16)
"""Values of ``search.max_hypotheses``."""
DEFAULT_HYPOTHESES = 8
RUN_RECORDING = "real_static/rooms_110"
"""The recording of the long run, below the data folder."""
RUN_SIZE = (60, 80)
"""Rows and columns to which it is reduced."""
RUN_MARKS = (100, 1000, 10_000)
"""Frames after which time and memory are taken."""
WINDOW = 200
"""Latest frames of which a mark takes the median time."""
COMPARED = ("hybrid",)
SEQUENCES = (1, 2, 4)
"""Sequences that one process and two compare."""
SEQUENCE_FRAMES = 10
STATUS = Path("/proc/self/status")
"""Where Linux states the memory of a process."""
RESIDENT = "VmRSS"
LARGEST = "VmHWM"


class Case(NamedTuple):
    """What a process tracks."""

    folder: Path
    hypotheses: int = DEFAULT_HYPOTHESES
    marks: tuple[int, ...] = (FRAMES,)


# --- the process of a case --------------------------------------------------------


def main(argv: list[str] | None = None) -> int:
    """Track one case, and print its figures as JSON."""
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("folder", type=Path, help="frames that this tool wrote")
    add("--hypotheses", type=int, default=DEFAULT_HYPOTHESES)
    add("--marks", default=str(FRAMES), help="frames after which figures are taken")
    add("--method", default=METHOD)
    args = parser.parse_args(argv)
    marks = tuple(map(int, args.marks.split(",")))
    case = Case(args.folder, args.hypotheses, marks)
    print(json.dumps(tracked(case, args.method)))
    return 0


def tracked(case: Case, method: str) -> dict[str, Any]:
    """Time and memory of a tracker at every mark, and its memory before the first frame."""
    from hybridvo import Odometry, Options

    options = Options()
    search = replace(options.search, max_hypotheses=case.hypotheses)
    odometry = Odometry(method=method, options=replace(options, search=search))
    odometry.warm_up()
    start_mib = memory_mib(RESIDENT)
    times = []
    rows = []
    for frame in endless(case.folder, case.marks[-1]):
        times.append(timed(partial(odometry.track, frame))[1])
        if len(times) in case.marks:
            rows.append(mark(times) | {"frames": len(times)})
    return {"start_mib": start_mib, "rows": rows}


def mark(times: list[float]) -> dict[str, Any]:
    """The median time of the latest frames, ms, and the memory, MiB."""
    latest = times[FIRST:][-WINDOW:]
    return {
        "ms": digits(np.median(latest)),
        "memory_mib": memory_mib(RESIDENT),
        "peak_mib": memory_mib(LARGEST),
    }


def endless(folder: Path, count: int) -> Iterator[Frame]:
    """So many frames: to and fro over those of a folder."""
    paths = sorted(folder.glob("*.npz"))
    for number, place in zip(range(count), to_and_fro(len(paths)), strict=False):
        yield read_frame(paths[place], number)


def to_and_fro(count: int) -> Iterator[int]:
    """Numbers from 0 to the last one of ``count`` and back, without end."""
    there = [*range(count), *range(count - 2, 0, -1)]
    while True:
        yield from there


def memory_mib(name: str) -> float | None:
    """A line of the memory of this process, MiB; None where the system does not state it."""
    if not STATUS.is_file():
        return None
    return memory_of(STATUS.read_text(encoding="utf-8"), name)


def memory_of(text: str, name: str) -> float:
    """MiB in the line of ``/proc/self/status`` that begins with a name."""
    (line,) = (line for line in text.splitlines() if line.startswith(f"{name}:"))
    kib = float(line.split()[1])
    return digits(kib / 2**10)


def write_frames(folder: Path, frames: Iterable[Frame]) -> Path:
    """Write frames, each into a file of its own; returns the folder."""
    folder.mkdir()
    for number, frame in enumerate(frames):
        path = folder / f"{number:06d}.npz"
        np.savez(path, rgb=frame.rgb, depth=frame.depth, K=frame.camera.K)
    return folder


def read_frame(path: Path, number: int) -> Frame:
    """A frame of a folder as the ``number``-th one of a run."""
    with np.load(path) as arrays:
        rgb = arrays["rgb"]
        depth = arrays["depth"]
        camera = Camera.from_matrix(arrays["K"], *depth.shape)
    return Frame(rgb, depth, camera, timestamp=number / 30, index=number)


# --- the cases --------------------------------------------------------------------


def growth(args: argparse.Namespace) -> dict[str, Any]:
    """Every case; ``args``: ``data``, and ``run_frames`` of the long run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        result = {
            "method": METHOD,
            "otherwise": list(SIZE),
            "size": by_size(folder),
            "moving": by_moving(folder),
            "hypotheses": by_hypotheses(folder),
        }
        if (args.data / RUN_RECORDING).is_dir():
            result["run"] = long_run(folder, args.data, args.run_frames)
        if find_spec("distributed") is not None:
            result["comparison"] = by_sequences(folder)
    return result


def in_process(case: Case) -> dict[str, Any]:
    """What a process of its own finds."""
    words = [*this_tool("growth"), str(case.folder)]
    words += ["--hypotheses", str(case.hypotheses)]
    words += ["--marks", ",".join(map(str, case.marks))]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def at_end(case: Case) -> dict[str, Any]:
    """Time and largest memory of a rendered case."""
    found = in_process(case)
    row = found["rows"][-1]
    return {
        "ms": row["ms"],
        "start_mib": found["start_mib"],
        "peak_mib": row["peak_mib"],
    }


def by_size(folder: Path) -> list[dict[str, Any]]:
    """Rows over the size of the images."""
    rows = []
    for size in SIZES:
        height, width = size
        frames = written(folder, GROWN_KIND, size)
        rows.append({"width": width, "height": height} | at_end(Case(frames)))
    return rows


def by_moving(folder: Path) -> list[dict[str, Any]]:
    """Rows over the fraction of the image that moves."""
    rows = []
    for kind in MOVING:
        scene = rendered(kind, 0, SIZE, FRAMES).scene
        covered = [scene.coverage(i) for i in range(FRAMES)]
        fraction = np.mean([each.moving_fraction for each in covered])
        named = {"kind": kind, "moving_fraction": digits(fraction)}
        rows.append(named | at_end(Case(written(folder, kind, SIZE))))
    return rows


def by_hypotheses(folder: Path) -> list[dict[str, Any]]:
    """Rows over the largest number of hypotheses."""
    frames = written(folder, MANY_KIND, SIZE)
    return [
        {"hypotheses": count} | at_end(Case(frames, count)) for count in HYPOTHESES
    ]


def written(folder: Path, kind: str, size: tuple[int, int]) -> Path:
    """The folder of a scene's frames, which are rendered once."""
    own = folder / f"{kind}_{size[0]}"
    if own.is_dir():
        return own
    return write_frames(own, rendered(kind, 0, size, FRAMES))


def long_run(folder: Path, data: Path, count: int) -> dict[str, Any]:
    """Time and memory along a run of so many frames."""
    from hybridvo import open_sequence
    from hybridvo.io.data.selected import SelectedSequence

    whole = open_sequence(data / RUN_RECORDING)
    small = SelectedSequence(whole, range(len(whole)), RUN_SIZE)
    frames = write_frames(folder / "run", small)
    marks = tuple(each for each in RUN_MARKS if each < count)
    found = in_process(Case(frames, marks=(*marks, count)))
    named = {"recording": RUN_RECORDING, "size": list(RUN_SIZE)}
    return named | {"window": WINDOW} | found


def by_sequences(folder: Path) -> list[dict[str, Any]]:
    """Rows over the sequences of a comparison, by one process and by two."""
    paths = scale.write_sequences(
        folder / "sequences", SEQUENCES[-1], SEQUENCE_FRAMES
    )
    each = {"frames": SEQUENCE_FRAMES, "size": list(scale.SIZE)}
    rows: list[dict[str, Any]] = [
        {"sequences": count, "seconds": {}} | each for count in SEQUENCES
    ]
    for processes in (1, 2):
        with scale.local_workers(processes) as where:
            # it loads kernels and networks in every process
            first = folder / f"first_{processes}"
            scale.compared(paths[:2], first, COMPARED, where)
            for row in rows:
                count = row["sequences"]
                out = folder / f"{processes}_{count}"
                seconds = scale.compared(paths[:count], out, COMPARED, where)
                row["seconds"][str(processes)] = digits(seconds)
    return rows


# --- the figure -------------------------------------------------------------------

TIME = "#0072B2"
MEMORY = "#D55E00"
"""Colours of Okabe and Ito."""
HEADROOM = 1.15
"""How high an axis is, in largest values."""


class Panel(NamedTuple):
    """A column of the figure: what grows, and what it costs."""

    title: str
    rows: list[dict[str, Any]]
    places: list[float]
    labels: list[str]
    memory: str = "peak_mib"
    is_logarithmic: bool = False


def panels_of(growth: dict[str, Any]) -> list[Panel]:
    """The columns of the figure."""
    sizes = growth["size"]
    moving = growth["moving"]
    limited = growth["hypotheses"]
    names = [f"{row['width']}x{row['height']}" for row in sizes]
    columns = [
        Panel(
            "size of the images, megapixels",
            sizes,
            [row["width"] * row["height"] / 1e6 for row in sizes],
            names,
        ),
        Panel(
            "moving fraction of the image, %",
            moving,
            [100 * row["moving_fraction"] for row in moving],
            [],
        ),
        Panel(
            "hypotheses, at most",
            limited,
            [row["hypotheses"] for row in limited],
            [],
        ),
    ]
    if "run" in growth:
        rows = growth["run"]["rows"]
        places = [row["frames"] for row in rows]
        columns.append(
            Panel("frames of a run", rows, places, [], "memory_mib", True)
        )
    return columns


def draw(growth: dict[str, Any], out: Path) -> None:
    """Time above, memory below; in the last column the time of a comparison."""
    columns = panels_of(growth)
    figure = Figure(figsize=(14.0, 5.2), dpi=100, layout="constrained")
    grid = figure.subplots(2, len(columns) + 1)
    for panel, (above, below) in zip(columns, grid.T, strict=False):
        draw_line(above, panel, "ms", TIME)
        draw_line(below, panel, panel.memory, MEMORY)
        below.set_xlabel(panel.title)
        for place, label in zip(panel.places, panel.labels, strict=False):
            below.annotate(
                label, (place, 0), (0, 3), textcoords="offset points", rotation=90,
                fontsize=7, ha="center",
            )  # fmt: skip
    grid[0, 0].set_ylabel("ms a tracked frame")
    grid[1, 0].set_ylabel("resident memory, MiB")
    if "comparison" in growth:
        draw_comparison(grid[0, -1], growth["comparison"])
    grid[1, -1].set_axis_off()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, metadata={"Software": None})


def draw_line(axes: Any, panel: Panel, key: str, colour: str) -> None:
    """A figure over what grows, from zero."""
    values = [row[key] for row in panel.rows]
    axes.plot(panel.places, values, "o-", color=colour)
    if panel.is_logarithmic:
        axes.set_xscale("log")
    axes.set_ylim(0, HEADROOM * max(values))
    axes.grid(True, color="#e4e4e4", linewidth=0.8)


def draw_comparison(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Seconds over the sequences of a comparison, by one process and by two."""
    places = [row["sequences"] for row in rows]
    for count, style in (("1", "o-"), ("2", "s--")):
        values = [row["seconds"][count] for row in rows]
        name = "one process" if count == "1" else "two processes"
        axes.plot(places, values, style, color=TIME, label=name)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("sequences of a comparison")
    axes.set_ylabel("seconds")
    axes.grid(True, color="#e4e4e4", linewidth=0.8)
    axes.legend(frameon=False)
