"""Measure every figure of the published tables at one commit, then fill the tables.

    python tools/tables.py --list                 # the parts, and how long they take
    python tools/tables.py                        # all that do not name this commit yet
    python tools/tables.py --only makers,costs
    python tools/tables.py --kind times           # only what must run alone; else: others

Parts without published times are measured two at a time, the others one after the other: leave
the machine idle. A part whose JSON file names the commit of the package is not measured again,
so a run that was stopped goes on. What a tool prints is in runs/tables. ``install`` needs an
environment that holds the package and nothing else: ``--clean-python``.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from bench.parts import PARTS, Part
from measuring import ROOT, parser_of, revision

RESULTS = ROOT / "docs" / "results"
LOGS = ROOT / "runs" / "tables"
INSTALLATION = "install"
"""The part that needs a clean environment."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure; the exit code is the number of parts that failed, 2 where the input is bad."""
    args = build_parser().parse_args(argv)
    commit = revision()
    wanted = [part for part in PARTS if is_wanted(args, part)]
    if unknown := set(args.only) - {part.name for part in PARTS}:
        print(f"tables.py: unknown parts {', '.join(sorted(unknown))}; see --list.")
        return 2
    due = [part for part in wanted if commit_of(part) != commit]
    if args.list:
        for part in wanted:
            print(described(part, "due" if part in due else "measured"))
        return 0
    if args.clean_python is None and any(part.name == INSTALLATION for part in due):
        print(f"{INSTALLATION}: left out, it needs --clean-python.")
        due = [part for part in due if part.name != INSTALLATION]
    LOGS.mkdir(parents=True, exist_ok=True)
    work = partial(measure_all, args)
    with ThreadPoolExecutor(args.jobs) as pool:
        together = list(pool.map(work, by_file(p for p in due if not p.alone)))
    alone = [work([part]) for part in due if part.alone]
    failed = [name for names in (*together, *alone) for name in names]
    if failed:
        print(f"failed: {', '.join(failed)}; see {LOGS}.")
    filled = subprocess.run(command_of("make_docs.py"), cwd=ROOT)
    return max(len(failed), filled.returncode)


def build_parser() -> argparse.ArgumentParser:
    """The arguments."""
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--list", action="store_true", help="show the parts, measure nothing")
    add(
        "--only",
        type=lambda text: text.split(","),
        default=[],
        metavar="PART,PART",
        help="default: all",
    )
    add(
        "--kind",
        choices=("all", "times", "others"),
        default="all",
        help="times: parts that run alone; default: all",
    )
    add("--jobs", type=int, default=2, help="parts without times that run at once")
    add("--data", default="../shared/data", metavar="DIR", help="recordings")
    add("--clean-python", metavar="FILE", help="for the part install")
    return parser


def is_wanted(args: argparse.Namespace, part: Part) -> bool:
    """Whether a part was asked for, by its name and its kind."""
    if args.only and part.name not in args.only:
        return False
    return args.kind == "all" or part.alone == (args.kind == "times")


def described(part: Part, state: str) -> str:
    """One line of the list."""
    how = "alone" if part.alone else "-"
    command = f"benchmark.py {part.tool} {part.options}"
    return f"{part.name:15s} {part.minutes:4g} min  {how:6s} {state:9s} {command}"


def by_file(parts: Iterable[Part]) -> list[list[Part]]:
    """The parts of each file, in their order: two tools must not write one file.

    Files that take long come first.
    """
    files: dict[str, list[Part]] = {}
    for part in parts:
        files.setdefault(part.file, []).append(part)
    return sorted(files.values(), key=lambda some: -sum(p.minutes for p in some))


def commit_of(part: Part) -> str | None:
    """The commit that a part's figures name; None where there are none."""
    path = RESULTS / f"{part.file}.json"
    if not path.exists():
        return None
    content = json.loads(path.read_text(encoding="utf-8"))
    if part.key:
        content = content.get(part.key, {})
    commit = content.get("commit")
    return commit if isinstance(commit, str) else None


def measure_all(args: argparse.Namespace, parts: Iterable[Part]) -> list[str]:
    """Measure some parts one after the other; return the names of those that failed."""
    return [part.name for part in parts if not is_measured(args, part)]


def is_measured(args: argparse.Namespace, part: Part) -> bool:
    """Measure a part, with what comes before and after it, and say how long it took."""
    out = RESULTS / f"{part.file}.json"
    words = part.words(args.data, str(out.relative_to(ROOT)))
    if part.name == INSTALLATION:
        words += ["--python", args.clean_python]
    commands = [command_of("benchmark.py", part.tool, *words)]
    if part.before:
        commands.insert(0, command_of(*shlex.split(part.before)))
    if part.after:
        commands.append(command_of(*shlex.split(part.after)))
    begin = time.monotonic()
    with (LOGS / f"{part.name}.log").open("w", encoding="utf-8") as log:
        done = all(is_done(command, log) for command in commands)
    minutes = (time.monotonic() - begin) / 60
    line = f"{part.name}: {'measured' if done else 'FAILED'}, {minutes:.1f} min"
    print(line, flush=True)
    with (LOGS / "durations.txt").open("a", encoding="utf-8") as file:
        file.write(line + "\n")
    return done


def command_of(tool: str, *words: str) -> list[str]:
    """The command of a program in tools/."""
    return [sys.executable, str(ROOT / "tools" / tool), *words]


def is_done(command: list[str], log: object) -> bool:
    """Run a command in one thread for each library, as figures name it."""
    environment = {"OMP_NUM_THREADS": "1"} | os.environ
    done = subprocess.run(
        command, cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT
    )
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
