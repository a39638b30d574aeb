r"""Known vulnerabilities of the pinned versions, by pip-audit; part of ``make check``.

    python tools/audit.py constraints.txt

pip-audit itself calls a package that its source of advisories does not know "not vulnerable", so on
a machine that reaches a private index alone it would find everything in order. Here that is said to
be skipped, with the reason, and so is an unreachable source. Exit code 1: a vulnerability is known.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

SECONDS = 180


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="audit.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("pins", nargs="?", type=Path, default=Path("constraints.txt"))
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if not args.pins.is_file():
        print(f"audit.py: {args.pins}: no such file.", file=sys.stderr)
        return 2
    if importlib.util.find_spec("pip_audit") is None:
        print("audit skipped: pip-audit is not installed; pip install 'hybridvo[audit]'")
        return 0
    command = [sys.executable, "-m", "pip_audit", "--requirement", str(args.pins)]
    command += ["--no-deps", "--disable-pip", "--format", "json", "--progress-spinner", "off"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        print(f"audit skipped: no answer from the advisory data within {SECONDS} s")
        return 0
    code, text = verdict(done.stdout, done.stderr)
    print(text)
    return code


def verdict(stdout: str, stderr: str) -> tuple[int, str]:
    """Exit code and what to print for an answer of pip-audit."""
    try:
        packages = json.loads(stdout)["dependencies"]
    except (ValueError, KeyError, TypeError):
        last = ([line for line in stderr.splitlines() if line.strip()] or ["no output"])[-1]
        if "Error" in last or "error" in last:
            return 0, f"audit skipped: the advisory data cannot be reached: {_kind(last)}"
        return 1, f"audit: pip-audit gave no answer: {last}"
    known = [entry for entry in packages if "skip_reason" not in entry]
    unknown = [entry["name"] for entry in packages if "skip_reason" in entry]
    if not known:
        return 0, f"audit skipped: the advisory data knows none of the {len(unknown)} packages"
    found = [
        f"{entry['name']} {entry['version']}: {hit['id']}, "
        + (f"mended in {', '.join(hit['fix_versions'])}" if hit["fix_versions"] else "not mended")
        for entry in known
        for hit in entry["vulns"]
    ]
    if found:
        return 1, "audit: known vulnerabilities\n" + "\n".join(found)
    rest = f"; not known: {', '.join(unknown)}" if unknown else ""
    return 0, f"audit: {len(known)} packages, none with a known vulnerability{rest}"


def _kind(line: str) -> str:
    """``ConnectionError`` of ``requests.exceptions.ConnectionError: a long story``."""
    return line.partition(":")[0].rpartition(".")[2]


if __name__ == "__main__":
    sys.exit(main())
