r"""The README's promises on a machine that has never seen this project.

    python tools/fresh_machine.py                         # every Python >= 3.11 that is found
    python tools/fresh_machine.py --python python3.12 --tests "tests/test_readme.py -q"

A clean clone of the last commit, an empty HOME, a bare environment. There the README's own two
commands are run (``make demo``, ``make test``), then its Python block, and what they print is
compared with what the README shows: the same table, words and columns, and numbers of accuracy that
agree within a fifth (OpenCV's DIS differs between processors; times are not compared).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
OLDEST = (3, 11)
KEEP = ("PATH", "LANG", "LC_ALL", "TMPDIR", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE",
        "HYBRIDVO_DATA")  # fmt: skip
"""Of the environment; beside these, what pip needs to find its packages on this machine."""
TOLERANCE = 0.2
"""Relative, or 0.005 in the unit of the column: OpenCV picks its DIS kernels by processor."""

BLOCK = r"""
import re, sys
from types import SimpleNamespace
import cv2
import numpy as np

text = open("README.md", encoding="utf-8").read()
blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
texture = np.random.default_rng(0).uniform(0, 255, (480, 700)).astype(np.float32)
texture = cv2.normalize(cv2.GaussianBlur(texture, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)

def sensor():
    for i in range(3):
        grey = texture[:, 2 * i : 2 * i + 640].astype(np.uint8)
        rgb = np.repeat(grey[..., None], 3, axis=2)
        yield rgb, np.full((480, 640), 3.0, np.float32), 0.1 * i

for code in blocks:
    factors = []
    graph = SimpleNamespace(add_between=lambda T, covariance: factors.append((T, covariance)))
    exec(compile(code, "README.md", "exec"), {"sensor": sensor(), "graph": graph})
    assert len(factors) == 3, f"{len(factors)} factors of 3"
    assert all(np.isfinite(T).all() and np.isfinite(C).all() for T, C in factors)
print(len(blocks), "blocks")
"""
"""Frames whose content moves by 2 px: the README's loop asks for a sensor and a graph."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fresh_machine.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--python", action="append", metavar="PROGRAM", help="default: all that are found"
    )
    parser.add_argument(
        "--tests",
        metavar="ARGUMENTS",
        help="of pytest, instead of the whole suite ('' runs none)",
    )
    parser.add_argument("--out", type=Path, help="write the outcome as JSON")
    parser.add_argument("--keep", type=Path, help="work in this new folder and leave it there")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    programs = args.python or pythons()
    if not programs:
        print("fresh_machine.py: no Python >= 3.11 was found.", file=sys.stderr)
        return 2
    if args.keep is not None and args.keep.exists():
        print(f"fresh_machine.py: {args.keep} exists; name a new folder.", file=sys.stderr)
        return 2
    outcome: list[dict[str, Any]] = []
    for program in programs:
        found = version(program)
        if found is None or found < OLDEST:
            print(f"fresh_machine.py: {program}: no Python >= 3.11.", file=sys.stderr)
            return 2
        with tempfile.TemporaryDirectory(prefix="hybridvo-fresh-") as scratch:
            name = ".".join(map(str, found))
            folder = Path(scratch) if args.keep is None else args.keep / name
            outcome.append(visit(folder, program, args.tests) | {"python": name})
        print(json.dumps({k: v for k, v in outcome[-1].items() if k != "printed"}), flush=True)
    failed = [entry["python"] for entry in outcome if entry["problems"]]
    if args.out is not None:
        command = ["fresh_machine.py", *(sys.argv[1:] if argv is None else argv)]
        content = {"command": command, "visits": outcome}
        args.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(f"{len(outcome) - len(failed)} of {len(outcome)} as the README says")
    return int(bool(failed))


def pythons() -> list[str]:
    """One program for each version of Python from 3.11 on, on the path or among pyenv's."""
    places = [Path(part) for part in os.environ.get("PATH", "").split(os.pathsep) if part]
    roots = [Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"]
    places += [path / "bin" for root in roots if root.is_dir() for path in root.iterdir()]
    found: dict[tuple[int, ...], str] = {}
    for place in places:
        for path in sorted(place.glob("python3.*")) if place.is_dir() else []:
            if re.fullmatch(r"python3\.\d+", path.name):
                number = version(str(path))
                if number is not None and number >= OLDEST:
                    found.setdefault(number[:2], str(path))
    return [found[number] for number in sorted(found)]


def version(program: str) -> tuple[int, ...] | None:
    code = "import ensurepip, ssl, sys, venv; print(*sys.version_info[:3])"
    try:
        done = subprocess.run([program, "-c", code], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return tuple(map(int, done.stdout.split())) if done.returncode == 0 else None


def visit(folder: Path, program: str, tests: str | None) -> dict[str, Any]:
    """Clone, install, demo, Python block, tests; what was printed and what is not as promised."""
    folder.mkdir(parents=True, exist_ok=True)
    home, clone = folder / "home", folder / "clone"
    home.mkdir()
    problems: list[str] = []
    seconds: dict[str, float] = {}
    tests_said = ""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    readme = (clone / "README.md").read_text(encoding="utf-8")
    environment = {k: v for k, v in os.environ.items() if k in KEEP or k.startswith("PIP_")}
    environment |= {"HOME": str(home), "PYTHON": program}
    data = ROOT.parent / "shared" / "data"
    if data.is_dir():  # the tests look for it beside the clone
        environment.setdefault("HYBRIDVO_DATA", str(data))
    configured = Path.home() / ".config" / "pip"
    if configured.is_dir() and "PIP_CONFIG_FILE" not in environment:
        environment["PIP_CONFIG_FILE"] = str(configured / "pip.conf")

    def run(name: str, command: list[str]) -> subprocess.CompletedProcess[str]:
        started = time.perf_counter()
        done = subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True)
        seconds[name] = round(time.perf_counter() - started, 1)
        if done.returncode != 0:
            text = (done.stdout + done.stderr).strip()
            failed = [line for line in text.splitlines() if line.startswith(("FAILED", "E  "))]
            said = "\n".join([*failed[:40], text[-300:]])
            problems.append(f"{name}: exit code {done.returncode}: {said}")
        return done

    shown = re.findall(r"^```sh\n(.*?)^```$", readme, re.DOTALL | re.MULTILINE)[0].splitlines()
    commands = [line.split("#")[0].split() for line in shown]
    if commands != [["make", "demo"], ["make", "test"]]:
        problems.append(f"the README's first block is not make demo, make test: {shown}")
    demo = run("make demo", ["make", "demo"])
    printed = demo.stdout[max(0, demo.stdout.find("20 rendered frames")) :]
    if demo.returncode == 0:
        problems += differences(shown_demo(readme), printed)
        binary = str(clone / ".venv" / "bin")
        block = run("Python block", [f"{binary}/python", "-c", BLOCK])
        if block.returncode == 0 and not re.search(r"^[1-9]\d* blocks$", block.stdout, re.M):
            problems.append("the README has no Python block")
        if tests is None:
            tests_said = run("make test", ["make", "test"]).stdout
        elif tests:
            tests_said = run("tests", [f"{binary}/python", "-m", "pytest", *tests.split()]).stdout
    closing = re.findall(r"^=+ (.* in [\d.]+s.*) =+$", tests_said, re.MULTILINE)
    left = sorted(path.name for path in home.iterdir())
    changed = subprocess.run(
        ["git", "status", "--short"], cwd=clone, capture_output=True, text=True, check=True
    )
    if changed.stdout:
        problems.append(f"the clone is not clean afterwards: {changed.stdout.strip()}")
    return {
        "commit": commit(clone),
        "seconds": seconds,
        "tests": closing[-1] if closing else None,
        "in_home_afterwards": left,
        "printed": printed,
        "problems": problems,
    }


def commit(clone: Path) -> str:
    done = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=clone, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def shown_demo(readme: str) -> str:
    """What the README says that the demo prints."""
    part = re.search(r"<!-- table:demo -->\s*```text\n(.*?)```", readme, re.DOTALL)
    return "" if part is None else part[1]


def differences(shown: str, printed: str) -> list[str]:
    """Lines that differ in their words, or in a number of accuracy beyond the tolerance."""
    ours, theirs = lines_of(shown), lines_of(printed)
    if not ours or len(ours) != len(theirs):
        return [f"demo: {len(theirs)} lines instead of {len(ours)}: {printed[-300:]!r}"]
    found = []
    for expected, got in zip(ours, theirs, strict=True):
        words = [re.split(r"\s{2,}", line.strip()) for line in (expected, got)]
        timed = len(words[0]) == 7 and words[0][0] != "method"
        if len(words[0]) != len(words[1]):
            found.append(f"demo: {got!r} instead of {expected!r}")
            continue
        # the last column of the table is a time
        cells = list(zip(*words, strict=True))[: -1 if timed else None]
        if not all(alike(a, b) for a, b in cells):
            found.append(f"demo: {got!r} instead of {expected!r}")
    return found


def lines_of(text: str) -> list[str]:
    """Without blank lines and without the ruler, whose width follows the numbers."""
    return [line for line in text.splitlines() if line.strip() and not set(line) <= set("- ")]


def alike(expected: str, got: str) -> bool:
    try:
        a, b = float(expected), float(got)
    except ValueError:
        return expected == got
    return abs(a - b) <= max(TOLERANCE * abs(a), 0.005)


if __name__ == "__main__":
    if shutil.which("git") is None or shutil.which("make") is None:
        sys.exit("fresh_machine.py: git and make are needed.")
    sys.exit(main())
