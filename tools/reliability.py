r"""The table of docs/reliability.md, from what the tests and the campaigns did.

    python tools/reliability.py --run             # run the tests that tests/faults.yaml names
    python tools/reliability.py --missing         # or those of them that have no outcome yet
    python tools/reliability.py --junit FILE ...  # or take pytest's XML (-o junit_family=xunit1)
    python tools/reliability.py                   # only make the page again
    python tools/reliability.py --check           # exit code 1 if the page is not up to date

A test that is named and does not exist is an error; one that was not run is said to be so, and the
exit code is 1, as it is where a test fails. Counted are test cases, the
examples of hypothesis, and what a test says about itself by ``record_property("tries", n)``.
"""

from __future__ import annotations

import argparse
import ast
import base64
import json
import os
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
FAULTS = ROOT / "tests" / "faults.yaml"
RESULTS = ROOT / "docs" / "results"
PAGE = ROOT / "docs" / "reliability.md"
COUNT = 44
"""Rows of the matrix."""
PACKAGES = ("hybridvo", "numpy", "scipy", "torch", "opencv-python-headless", "numba")
EXAMPLES = re.compile(r"(\d+) passing(?: examples)?, (\d+) failing")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="reliability.py", description=(__doc__ or "").splitlines()[0]
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--run", action="store_true", help="run the named tests first")
    what.add_argument("--missing", action="store_true", help="run those without an outcome first")
    what.add_argument("--junit", type=Path, nargs="+", help="XML of pytest runs")
    what.add_argument("--check", action="store_true", help="write nothing, only compare")
    parser.add_argument("--faults", type=Path, default=FAULTS)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--page", type=Path, default=PAGE)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    target = args.results / "reliability.json"
    try:
        matrix = read_faults(args.faults)
        names = named_tests(matrix)
        known = json.loads(target.read_text(encoding="utf-8"))["tests"] if target.exists() else {}
        if args.run or args.missing or args.junit:
            known = {} if args.run else {name: known[name] for name in names if name in known}
            with tempfile.TemporaryDirectory() as scratch:
                xml = Path(scratch) / "tests.xml"
                left = [name for name in names if name not in known]
                paths = args.junit or ([run_tests(left, xml)] if left else [])
                rows = known | collect(paths, names)
            found = {"command": ["python", "tools/reliability.py", "--run"], **surroundings()}
            found["tests"] = {name: rows[name] for name in names if name in rows}
            write(target, json.dumps(found, indent=1) + "\n")
        content = json.loads(target.read_text(encoding="utf-8"))
        campaigns = read_campaigns(args.results)
        made = page(matrix, content, campaigns)
    except (OSError, ValueError, KeyError, ElementTree.ParseError) as error:
        print(f"reliability.py: {error}", file=sys.stderr)
        return 2
    if args.check:
        before = args.page.read_text(encoding="utf-8") if args.page.is_file() else ""
        if made != before:
            print(f"{args.page}: differs from {args.results}", file=sys.stderr)
        return int(made != before)
    write(args.page, made)
    print(args.page)
    failing = [name for name, row in content["tests"].items() if row["failed"]]
    absent = [name for name in names if name not in content["tests"]]
    for label, group in (("FAILED", failing), ("not run", absent)):
        for name in group:
            print(f"{label} {name}", file=sys.stderr)
    return int(bool(failing or absent))


def write(path: Path, text: str) -> None:
    partial = path.with_name(path.name + ".tmp")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


# What is asked for


def read_faults(path: Path) -> dict[str, Any]:
    """The matrix; ValueError unless it has all rows and every named test exists."""
    matrix = yaml.safe_load(path.read_text(encoding="utf-8"))
    expected = [f"F{n}" for n in range(1, COUNT + 1)]
    if list(matrix["faults"]) != expected:
        raise ValueError(f"{path}: expected the rows F1 to F{COUNT} in order.")
    known: dict[str, set[str]] = {}
    for name in named_tests(matrix):
        file, _, function = name.partition("::")
        if file not in known:
            known[file] = functions(ROOT / file)
        if function not in known[file]:
            raise ValueError(f"{path}: {name}: there is no such test.")
    return matrix


def named_tests(matrix: Mapping[str, Any]) -> list[str]:
    """Every test that the matrix names, once, in order."""
    rows = [*matrix["faults"].values(), *matrix["totals"]]
    return list(dict.fromkeys(name for row in rows for name in row["tests"]))


def functions(path: Path) -> set[str]:
    if not path.is_file():
        raise ValueError(f"{path.name}: there is no such file of tests.")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


# What was done


def run_tests(names: list[str], xml: Path) -> Path:
    """One process: pytest-xdist leaves out the statistics of hypothesis."""
    command = [sys.executable, "-m", "pytest", "-q", "-o", "junit_family=xunit1"]
    command += [f"--junitxml={xml}", *names]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False)
    if done.returncode not in (0, 1):  # 1: some failed, which the page will say
        raise ValueError(f"pytest ended with exit code {done.returncode}.")
    return xml


def collect(paths: list[Path], names: list[str]) -> dict[str, dict[str, Any]]:
    """Cases, tries, failures and skips of each named test that was run."""
    suites = [s for path in paths for s in ElementTree.parse(path).getroot().iter("testsuite")]
    rows: dict[str, dict[str, Any]] = {}
    examples = statistics(suites)
    now = commit()
    for case in (case for suite in suites for case in suite.iter("testcase")):
        name = f"{case.get('file')}::{str(case.get('name')).partition('[')[0]}"
        if name not in names:
            continue
        empty = {"commit": now, "cases": 0, "tries": 0, "failed": 0, "skipped": 0, "reasons": []}
        row = rows.setdefault(name, empty)
        row["cases"] += 1
        row["failed"] += case.find("failure") is not None or case.find("error") is not None
        skip = case.find("skipped")
        if skip is not None:
            row["skipped"] += 1
            row["reasons"] = sorted({*row["reasons"], str(skip.get("message"))})
            continue
        own = [p.get("value") for p in case.iter("property") if p.get("name") == "tries"]
        said = examples.get(f"{case.get('file')}::{case.get('name')}", 0)
        row["tries"] += int(own[0] or 0) if own else max(1, said)
    return rows


def surroundings() -> dict[str, Any]:
    return {
        "python": sys.version.split()[0],
        "versions": {name: version(name) for name in PACKAGES},
    }


def statistics(suites: list[ElementTree.Element]) -> dict[str, int]:
    """Examples that hypothesis tried, by test; it leaves its figures beside the cases."""
    found = {}
    for entry in (entry for suite in suites for entry in suite.iter("property")):
        name = str(entry.get("name"))
        if name.startswith("hypothesis-statistics-"):
            text = base64.b64decode(str(entry.get("value"))).decode()
            tried = sum(int(a) + int(b) for a, b in EXAMPLES.findall(text))
            found[name.removeprefix("hypothesis-statistics-")] = tried
    return found


def commit() -> str:
    done = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
    )
    return done.stdout.strip() or "unknown"


def read_campaigns(results: Path) -> dict[str, Any]:
    """Content of the JSON files of the campaigns that are there."""
    found = {}
    for name in ("stress", "fuzz", "degenerate"):
        path = results / f"{name}.json"
        if path.is_file():
            found[name] = json.loads(path.read_text(encoding="utf-8"))
    return found


def lookup(campaigns: Mapping[str, Any], dotted: str) -> Any:
    """Value at ``file.campaign.key``, or None."""
    value: Any = campaigns
    for part in dotted.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


# The page


def page(
    matrix: Mapping[str, Any], content: Mapping[str, Any], campaigns: Mapping[str, Any]
) -> str:
    """The whole page; tests without an outcome count as not run."""
    empty = {"cases": 0, "tries": 0, "failed": 0, "skipped": 0, "absent": 1, "reasons": []}
    tests = {name: content["tests"].get(name, empty) for name in named_tests(matrix)}
    absent = sum(row.get("absent", 0) for row in tests.values())
    commits = sorted({row["commit"] for row in tests.values() if "commit" in row})
    versions = ", ".join(f"{name} {value}" for name, value in content["versions"].items())
    lines = [
        "# Reliability",
        "",
        "Made by `python tools/reliability.py` from `tests/faults.yaml` and "
        "`docs/results/reliability.json`, which holds the outcome of the tests that the former "
        "names. Tries are test cases, examples that hypothesis drew, and repetitions inside of a "
        "test where it counts them; most loops inside of a test are not counted. Campaigns are "
        "longer runs of `tools/stress.py`, `tests/fuzz/fuzz.py` and `tools/measure_degenerate.py`.",
        "",
        f"{len(tests)} tests, {sum(row['cases'] for row in tests.values())} cases"
        + (f", **{absent} of the tests not run**" if absent else "")
        + f"; commit {', '.join(commits)}, Python {content['python']}; {versions}.",
        "",
        "## Totals",
        "",
        "| what must not happen | tests, tries | happened | campaigns |",
        "|---|---:|---:|---|",
    ]
    for row in matrix["totals"]:
        count = sums(row["tests"], tests)
        lines.append(
            f"| {row['what']} | {count['tests']}, {count['tries']} | {count['failed']} | "
            f"{total_of_campaigns(row, campaigns)} |"
        )
    lines += [*degenerate(campaigns.get("degenerate")), "", "## Faults", ""]
    lines += ["| | fault | how it is made | tries | result |", "|---|---|---|---:|---|"]
    for name, row in matrix["faults"].items():
        count = sums(row["tests"], tests)
        tried = str(count["tries"])
        for dotted in row.get("campaigns", ()):
            value = lookup(campaigns, dotted)
            label = dotted.split(".", 1)[1].replace(".", " ").replace("_", " ")
            tried += f"; {label}: {'not measured' if value is None else value}"
        lines.append(
            f"| {name} | {row['what']} | {row['made']} | {tried} | {outcome(count, row, tests)} |"
        )
    lines += ["", *campaign_part(campaigns), "## Tests of each fault", ""]
    for name, row in matrix["faults"].items():
        short = [f"`{t.removeprefix('tests/').removeprefix('unit/')}`" for t in row["tests"]]
        lines.append(f"- **{name}** " + ", ".join(short))
    return "\n".join(lines) + "\n"


def sums(names: list[str], tests: Mapping[str, Any]) -> dict[str, int]:
    keys = ("cases", "tries", "failed", "skipped", "absent")
    found = {key: sum(tests[name].get(key, 0) for name in names) for key in keys}
    return found | {"tests": len(names)}


def outcome(count: Mapping[str, int], row: Mapping[str, Any], tests: Mapping[str, Any]) -> str:
    if count["failed"]:
        names = [name.partition("::")[2] for name in row["tests"] if tests[name]["failed"]]
        return f"**{count['failed']} of {count['cases']} FAIL**: {', '.join(names)}"
    if count["absent"]:
        return f"{count['absent']} of {count['tests']} tests not run"
    if not count["skipped"]:
        return "as it should"
    reasons = sorted({reason for name in row["tests"] for reason in tests[name]["reasons"]})
    return f"as it should; {count['skipped']} skipped: {'; '.join(reasons)}"


def total_of_campaigns(row: Mapping[str, Any], campaigns: Mapping[str, Any]) -> str:
    """What the campaigns counted under the same heading."""
    parts = []
    for key in row.get("counted", ()):
        for name, figures in campaigns.get("stress", {}).items():
            if not isinstance(figures, Mapping):
                continue
            tried = [figures.get(what) for what in ("runs", "rounds", name, "frames")]
            runs = next((count for count in tried if count is not None), "?")
            if isinstance(figures.get(key), int):
                parts.append(f"{name.replace('_', ' ')}: {int(figures[key])} of {runs}")
            elif key == "not_finite" and isinstance(figures.get("finite"), bool):
                said = "none" if figures["finite"] else "some"
                parts.append(f"{name.replace('_', ' ')}: {said} of {runs} frames")
    for dotted in row.get("campaigns", ()):
        value = lookup(campaigns, dotted)
        if value is not None:
            parts.append(f"{dotted}: {value}")
    return ", ".join(parts) or "-"


def degenerate(found: Mapping[str, Any] | None) -> list[str]:
    """Answers on degenerate data that are wrong and confident."""
    lines = ["", "### Confident wrong poses on degenerate data", ""]
    if found is None:
        return [*lines, "Not measured: `python tools/measure_degenerate.py`."]
    first, last = found["seeds"]
    lines += [
        "Status ok and an error outside of the ellipsoid of three standard deviations (chi-square "
        "of the six components above 20.06: 0.27 % for a perfect covariance); in a component: some "
        "one of the six beyond three of its own (up to 1.6 %). Every kind has a random stream of "
        f"its own; seeds {first} to {last}, {found['size'][1]}x{found['size'][0]}. "
        f"`{' '.join(found['command'])}`",
        "",
        "| kind | data | method | pairs | ok | wrong and ok | in a component | not finite |",
        "|---|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in found["rows"]:
        data = "noise" if row["noise"] else "exact"
        lines.append(
            f"| {row['kind'].replace('_', ' ')} | {data} | `{row['method']}` | {row['pairs']} | "
            f"{row['ok']} | {row['wrong']} | {row.get('outside', '-')} | {row['not_finite']} |"
        )
    for data, methods in found["total"].items():
        for method, count in methods.items():
            lines.append(
                f"| **all** | {data} | `{method}` | {count['pairs']} | {count['ok']} | "
                f"**{count['wrong']}** ({100 * count['wrong'] / max(count['pairs'], 1):.1f} % of "
                f"the pairs, {100 * count['wrong'] / max(count['ok'], 1):.1f} % of the ok) | "
                f"{count.get('outside', '-')} | {count['not_finite']} |"
            )
    return lines


def campaign_part(campaigns: Mapping[str, Any]) -> list[str]:
    """Plain figures of each campaign, as its tool wrote them."""
    lines = ["## Campaigns", ""]
    for file in ("stress", "fuzz"):
        content = campaigns.get(file)
        if content is None:
            lines += [f"`docs/results/{file}.json` is not there: not measured.", ""]
            continue
        for name, figures in content.items():
            if name in ("machine", "versions", "command", "commit") or not isinstance(
                figures, dict
            ):
                continue
            plain = ", ".join(_plain(figures))
            lines.append(f"- **{file}: {name.replace('_', ' ')}**: {plain}")
        lines.append("")
    return lines


def _plain(figures: Mapping[str, Any]) -> list[str]:
    """Numbers by their names, those of nested figures in brackets."""
    found = []
    for key, value in figures.items():
        name = key.replace("_", " ")
        if isinstance(value, Mapping):
            found.append(f"{name} ({', '.join(_plain(value))})")
        elif isinstance(value, int | float | bool) and key != "seconds":
            found.append(f"{name} {_short(value)}")
    return found


def _short(value: float) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
