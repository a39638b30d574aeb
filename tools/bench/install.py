r"""How large an installation is, and how long its import and its first pose take.

    python -m venv clean && clean/bin/pip install hybridvo-*.whl
    python tools/benchmark.py install --python clean/bin/python --out docs/results/install.json
    python tools/build_wheel.py --out dist
    python tools/benchmark.py install --parts wheels,speed --overwrite \
        --out docs/results/install.json

Everything is measured in the environment of ``--python``, in fresh processes. Sizes are those of
the files that pip lists for each package, without the byte code. The other parts unpack each
wheel of ``--wheels`` (by default ``dist``) before that environment, and track with an empty home
and an empty cache. With ``--overwrite`` the other parts of the file stay.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import measuring

SIZES = """
import importlib.metadata, json
sizes = {}
for package in importlib.metadata.distributions():
    paths = [file.locate() for file in package.files or ()]
    kept = [path for path in paths if path.suffix != ".pyc" and path.is_file()]
    sizes[package.metadata["Name"].lower()] = sum(path.stat().st_size for path in kept)
print(json.dumps(sizes))
"""
NEEDS_OF_TORCH = """
import importlib.metadata, json, re
def needs(name, found):
    if name in found:
        return found
    found.add(name)
    for text in importlib.metadata.requires(name) or ():
        # torch takes the libraries of CUDA by extras of one package
        if "extra ==" not in text or name == "cuda-toolkit":
            needed = re.match(r"[\\w.-]+", text)[0].lower()
            try:
                needs(needed, found)
            except importlib.metadata.PackageNotFoundError:
                found.discard(needed)
    return found
print(json.dumps(sorted(needs("torch", set()))))
"""
IMPORT = """
import time
start = time.perf_counter()
used = time.process_time()
import hybridvo as hvo
hvo.Odometry, hvo.Frame, hvo.Camera
print([time.perf_counter() - start, time.process_time() - used])
"""
FIRST_POSE = """
import time
start = time.perf_counter()
used = time.process_time()
import numpy as np
import hybridvo as hvo
from hybridvo_lab.synthetic.scenes import make_scene
scene = make_scene("light", 0, height=218, width=512, frames=2)
frames = [scene.render(index) for index in range(2)]
rendered = time.perf_counter()
used_before = time.process_time()
tracker = hvo.Odometry()
steps = [tracker.track(frame) for frame in frames]
assert steps[1].usable
print([time.perf_counter() - rendered, time.process_time() - used_before])
"""


RENDER = """
import sys
import numpy as np
from hybridvo_lab.synthetic.scenes import make_scene
for kind in ("static", "light"):
    scene = make_scene(kind, 0, height=480, width=640, frames=12)
    frames = [scene.render(index) for index in range(12)]
    camera = frames[0].camera
    rgb = np.stack([frame.rgb for frame in frames])
    depth = np.stack([frame.depth for frame in frames])
    K = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    np.savez(f"{sys.argv[1]}/{kind}.npz", rgb=rgb, depth=depth, K=K)
print("null")
"""
"""Frames on disk, so that no process that is timed renders."""
READ = """
import os, sys, time
import numpy as np
stored = np.load(sys.argv[1])
rgb, depth, K = stored["rgb"], stored["depth"], stored["K"].tolist()
start = time.perf_counter()
used = time.process_time()
import hybridvo as hvo
assert hvo.__file__.startswith(os.environ["PYTHONPATH"])
camera = hvo.Camera(*K, height=depth.shape[1], width=depth.shape[2])
frames = []
for index, images in enumerate(zip(rgb, depth)):
    frames.append(hvo.Frame(*images, camera, timestamp=index / 30))
"""
FIRST_POSE_OF_PROCESS = (
    READ
    + """
tracker = hvo.Odometry()
steps = [tracker.track(frame) for frame in frames[:2]]
assert steps[1].usable
print([time.perf_counter() - start, time.process_time() - used])
"""
)
EVERY_FRAME = (
    READ
    + """
import json
known = {}
dis = hvo.dis_flow()
def flow(prev, curr):
    # computed in the first round: what is timed is the kernels
    # frames may be copies: their times identify them
    pair = prev.timestamp, curr.timestamp
    if pair not in known:
        known[pair] = dis(prev, curr)
    return known[pair]
def follow(tracker):
    times, path = [], []
    for frame in frames:
        used = time.process_time()
        step = tracker.track(frame)
        times.append(time.process_time() - used)
        path.append(step.T_world_cam[:3].tolist())
    return 1e3 * float(np.median(times[2:])), path
found = {}
for method, given in (("hybrid", None), ("classical", flow)):
    for _ in range(3):
        found[method] = follow(hvo.Odometry(method=method, flow=given))
print(json.dumps(found))
"""
)
SCENES = ("static", "light")
METHODS = ("hybrid", "classical")


def measured(
    python: str, code: str, *arguments: str, extra: dict[str, str] | None = None
) -> Any:
    """What a fresh process prints as JSON."""
    done = subprocess.run(
        # the folder of the call holds a clone, perhaps: -P keeps it out
        [python, "-P", "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | (extra or {}),
    )
    return json.loads(done.stdout.splitlines()[-1])


def smallest(times: list[list[float]]) -> dict[str, float]:
    """The smallest wall and CPU time of several processes, seconds."""
    wall, cpu = (min(values) for values in zip(*times, strict=True))
    return {"wall_s": round(wall, 3), "cpu_s": round(cpu, 3)}


def fastest(python: str, code: str, repeats: int) -> dict[str, float]:
    """The smallest times of several processes; the first one loads from the disk."""
    return smallest([measured(python, code) for _ in range(repeats)])


# --- wheels ---------------------------------------------------------------------------------------


class Unpacked:
    """A wheel in a folder, and places where nothing was ever stored."""

    def __init__(self, wheel: Path, folder: Path) -> None:
        self.megabytes = wheel.stat().st_size / 1e6
        self.folder = folder / wheel.stem
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(self.folder / "package")

    def environment(self, name: str) -> dict[str, str]:
        """The environment of a process: a name is a home, empty when it is new."""
        home = self.folder / name
        home.mkdir(exist_ok=True)
        return {
            "PYTHONPATH": str(self.folder / "package"),
            "HOME": str(home),
            "XDG_CACHE_HOME": str(home),
            "NUMBA_CACHE_DIR": str(home),
        }


def first_poses_of(
    python: str, wheel: Unpacked, frames: Path, repeats: int
) -> dict[str, Any]:
    """Times from the import of the package to the first pose, in a home that is new and later.

    Where the first compiles, it takes a minute and is measured once.
    """

    def once(scene: str, home: str) -> Any:
        path = str(frames / f"{scene}.npz")
        extra = wheel.environment(home)
        return measured(python, FIRST_POSE_OF_PROCESS, path, extra=extra)

    found: dict[str, Any] = {"megabytes": round(wheel.megabytes, 1)}
    # python compiles the source: what pip does when it installs
    subprocess.run(
        [python, "-m", "compileall", "-q", str(wheel.folder / "package")],
        check=True,
    )
    for scene in SCENES:
        fresh = [once(scene, f"new {scene}")]
        compiles = any((wheel.folder / f"new {scene}").rglob("*.nbc"))
        if not compiles:
            fresh += [once(scene, f"new {scene} {n}") for n in range(1, repeats)]
        warm = [once(scene, f"new {scene}") for _ in range(repeats)]
        found[scene] = {
            "compiles": compiles,
            "fresh": smallest(fresh),
            "warm": smallest(warm),
        }
    return found


def first_poses(
    python: str, wheels: dict[str, Unpacked], frames: Path, repeats: int
) -> dict[str, Any]:
    """Times to the first pose by wheel."""
    return {
        name: first_poses_of(python, wheel, frames, repeats)
        for name, wheel in sorted(wheels.items())
    }


def speed(
    python: str, wheels: dict[str, Unpacked], frames: Path, repeats: int
) -> dict[str, Any]:
    """CPU time of a frame with each wheel's kernels, in turn, and how far the paths differ."""
    scenes: dict[str, Any] = {}
    for scene in SCENES:
        path = str(frames / f"{scene}.npz")
        runs: dict[str, list[Any]] = {name: [] for name in wheels}
        for _ in range(repeats):
            for name, wheel in wheels.items():
                extra = wheel.environment("new light")
                runs[name].append(measured(python, EVERY_FRAME, path, extra=extra))
        scenes[scene] = {method: compared(method, runs) for method in METHODS}
    return {"scenes": scenes}


def compared(method: str, runs: dict[str, list[Any]]) -> dict[str, float]:
    """Milliseconds of a frame for each wheel, their ratio, and the distance of the paths."""
    ms = {
        name: statistics.median(run[method][0] for run in found)
        for name, found in runs.items()
    }
    paths = {name: found[0][method][1] for name, found in runs.items()}
    pure = flat(paths["pure"])
    compiled = flat(paths["compiled"])
    apart = max(abs(a - b) for a, b in zip(pure, compiled, strict=True))
    return {
        "compiled_ms": round(ms["compiled"], 2),
        "pure_ms": round(ms["pure"], 2),
        "ratio": round(ms["compiled"] / ms["pure"], 3),
        "largest_difference_m": measuring.digits(apart),
    }


def flat(values: Any) -> list[float]:
    """The numbers in lists of lists."""
    if not isinstance(values, list):
        return [values]
    return [number for value in values for number in flat(value)]


def of_wheels(
    python: str, folder: Path, repeats: int, figures: Callable[..., dict[str, Any]]
) -> dict[str, Any]:
    """Figures of the two wheels in a folder."""
    with tempfile.TemporaryDirectory() as work:
        unpacked = {}
        for path in folder.glob("*.whl"):
            name = "pure" if path.stem.endswith("-none-any") else "compiled"
            unpacked[name] = Unpacked(path, Path(work))
        frames = Path(work) / "frames"
        frames.mkdir()
        extra = unpacked["compiled"].environment("rendered")
        measured(python, RENDER, str(frames), extra=extra)
        return figures(python, unpacked, frames, repeats)


# --- an installation ------------------------------------------------------------------------------


def sizes(python: str) -> dict[str, Any]:
    """Megabytes of the installation, and of its largest packages."""
    megabytes = {name: x / 1e6 for name, x in measured(python, SIZES).items()}
    of_torch = set(measured(python, NEEDS_OF_TORCH))
    installers = {"pip", "setuptools"}
    own = {
        name: size
        for name, size in megabytes.items()
        if name not in of_torch | installers
    }
    largest = sorted(own, key=lambda name: -own[name])[:12]
    return {
        "total_mb": round(sum(megabytes.values())),
        "without_torch_mb": round(sum(own.values())),
        "packages": len(megabytes),
        "largest_mb": {name: round(own[name], 1) for name in largest},
    }


def of_environment(python: str, repeats: int) -> dict[str, Any]:
    """All figures of an environment."""
    # compiles the kernels, unless `doctor` has done it
    measured(python, FIRST_POSE)
    version = measured(python, "import sys; print(list(sys.version_info[:3]))")
    return {
        "python": ".".join(map(str, version)),
        "sizes": sizes(python),
        "import": fastest(python, IMPORT, repeats),
        "first_pose": fastest(python, FIRST_POSE, repeats),
    }


def build_parser() -> argparse.ArgumentParser:
    """The arguments."""
    parser = measuring.parser_of(__file__, __doc__)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--parts", default="environment", help=", ".join(PARTS))
    parser.add_argument("--wheels", type=Path, default=measuring.ROOT / "dist")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--overwrite", action="store_true")
    return parser


WHEEL_PARTS = {"wheels": first_poses, "speed": speed}
"""Parts that measure wheels, and how."""
PARTS = ("environment", *WHEEL_PARTS)
"""The first stands at the top of the file, the others under their names."""


def main(argv: list[str] | None = None) -> int:
    """Measure, and write the figures."""
    args = build_parser().parse_args(argv)
    name = "benchmark.py install"
    parts = args.parts.split(",")
    if unknown := set(parts) - set(PARTS):
        print(f"{name}: unknown parts: {', '.join(unknown)}", file=sys.stderr)
        return 2

    def figures() -> dict[str, Any]:
        found: dict[str, Any] = {}
        if args.out.exists():
            found = json.loads(args.out.read_text(encoding="utf-8"))
        origin = measuring.provenance(name, argv)
        if "environment" in parts:
            found |= origin | of_environment(args.python, args.repeats)
        for part in sorted(WHEEL_PARTS.keys() & parts):
            measure = WHEEL_PARTS[part]
            rows = of_wheels(args.python, args.wheels, args.repeats, measure)
            found[part] = origin | rows
        return found

    return measuring.write_result(name, args.out, args.overwrite, figures)
