"""How large an installation is, and how long its import and its first pose take.

    python -m venv clean && clean/bin/pip install hybridvo-*.whl
    python tools/benchmark_install.py --python clean/bin/python --out docs/results/install.json

Everything is measured in the environment of ``--python``, in fresh processes. Sizes are those of
the files that pip lists for each package, without the byte code.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
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
from hybridvo.synthetic.scenes import make_scene
scene = make_scene("light", 0, height=218, width=512, frames=2)
frames = [scene.render(index) for index in range(2)]
rendered = time.perf_counter()
used_before = time.process_time()
tracker = hvo.Odometry()
steps = [tracker.track(frame) for frame in frames]
assert steps[1].usable
print([time.perf_counter() - rendered, time.process_time() - used_before])
"""


def measured(python: str, code: str) -> Any:
    """What a fresh process prints as JSON."""
    done = subprocess.run(
        [python, "-c", code], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def fastest(python: str, code: str, repeats: int) -> dict[str, float]:
    """The smallest times of several processes, seconds; the first one loads from the disk."""
    times = [measured(python, code) for _ in range(repeats)]
    wall, cpu = (min(values) for values in zip(*times, strict=True))
    return {"wall_s": round(wall, 3), "cpu_s": round(cpu, 3)}


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


def measure(python: str, repeats: int) -> dict[str, Any]:
    """All figures of an environment."""
    measured(
        python, FIRST_POSE
    )  # compiles the kernels, unless `doctor` has done it
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
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--overwrite", action="store_true")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Measure, and write the figures."""
    args = build_parser().parse_args(argv)
    name = Path(__file__).name

    def figures() -> dict[str, Any]:
        origin = measuring.provenance(name, argv)
        return origin | measure(args.python, args.repeats)

    return measuring.write_result(name, args.out, args.overwrite, figures)


if __name__ == "__main__":
    sys.exit(main())
