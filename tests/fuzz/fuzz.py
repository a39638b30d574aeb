"""Coverage-guided fuzzing of everything that reads a file: ``python tests/fuzz/fuzz.py``.

Each target runs in a process of its own under atheris (libFuzzer for Python), starts from the
corpus beside this file and leaves what it finds in ``--out``: an input that broke a promise with
the traceback beside it, one for each place in the code. Fixed, it is kept in ``corpus/TARGET`` as
a regression. Coverage is that of the Python code; what OpenCV, torch and safetensors do inside is
only observed from outside.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import re
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent
GUIDED = ["hybridvo", "yaml"]
UNGUIDED = ("torch", "safetensors.torch", "scipy.spatial.transform", "hybridvo.pipeline")
UNGUIDED += ("hybridvo.network.judge", "hybridvo.network.pwvo")
"""Imported before the hook is set: large, and no reader."""
MAX_BYTES = 4096


def place(error: BaseException) -> str:
    """Type of an exception, and where in hybridvo it went through: one finding each."""
    stack = traceback.extract_tb(error.__traceback__)
    inside = [f"{Path(f.filename).stem}-{f.name}" for f in stack if "hybridvo" in f.filename]
    return f"{type(error).__name__}-{inside[-1] if inside else 'outside'}"


def fuzz(name: str, run: Callable[..., None], out: Path, folder: Path, seconds: int) -> None:
    """Fuzz one target in this process; never returns."""
    import atheris

    findings = out / "findings"

    def once(data: bytes) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            run(name, data, folder)
        except Exception as error:
            finding = findings / place(error)
            if not finding.exists() or finding.stat().st_size > len(data):
                finding.write_bytes(data)
                text = "".join(traceback.format_exception(error))
                finding.with_name(finding.name + ".txt").write_text(text, errors="replace")

    arguments = [str(out / "new"), str(HERE / "corpus" / name), "-print_final_stats=1"]
    arguments += [f"-max_total_time={seconds}", f"-max_len={MAX_BYTES}", "-timeout=30"]
    arguments += ["-rss_limit_mb=4096", f"-artifact_prefix={findings}/"]
    atheris.Setup([sys.argv[0], *arguments], once)
    atheris.Fuzz()


def main(argv: list[str] | None = None) -> int:
    """Run the targets one after the other; 1 where one of them found something."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", help="names, default all")
    parser.add_argument("--seconds", type=int, default=20, help="of each target")
    parser.add_argument("--out", default="runs/fuzz", help="folder for findings and new inputs")
    parser.add_argument("--report", type=Path, help="JSON file of the figures, as they come")
    args = parser.parse_args(argv)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # forked processes must not share threads
    try:
        import atheris
    except ImportError:
        print("fuzzing needs atheris: pip install -e '.[fuzz]' (CPython on Linux)", file=sys.stderr)
        return 2
    for module in UNGUIDED:
        importlib.import_module(module)
    sys.path.insert(0, str(HERE))
    with atheris.instrument_imports(include=GUIDED):
        import targets

        importlib.import_module("hybridvo.training.options")
    total, found = 0, 0
    report: dict[str, object] = {"command": ["fuzz.py", *(sys.argv[1:] if argv is None else argv)]}
    print(f"{'target':18} {'executions':>10} {'features':>8} {'cpu s':>6}  findings", flush=True)
    for name in args.targets or targets.TARGETS:
        out = Path(args.out).absolute() / name
        for folder in ("new", "findings"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        before = time.monotonic()
        # the child never returns to remove it
        scratch = tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
        process = os.fork()
        if process == 0:
            log = os.open(out / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            fuzz(name, targets.run, out, Path(scratch) / "x", args.seconds)
            os._exit(0)
        _, status, usage = os.wait4(process, 0)
        shutil.rmtree(scratch, ignore_errors=True)
        text = (out / "log.txt").read_text(errors="replace")
        counts = re.findall(r"^#(\d+)\s.*?ft: (\d+)", text, re.MULTILINE) or [("0", "0")]
        done = re.findall(r"stat::number_of_executed_units: (\d+)", text)
        executions = int((done or [counts[-1][0]])[-1])
        names = (p.name for p in (out / "findings").iterdir() if p.suffix != ".txt")
        places = sorted(n for n in names if not n.startswith("slow-unit"))
        if status != 0 and time.monotonic() - before < args.seconds:
            places.append(f"ended early, status {status}: see {out / 'log.txt'}")
        total, found = total + executions, found + len(places)
        spent = usage.ru_utime + usage.ru_stime
        row = f"{name:18} {executions:10d} {counts[-1][1]:>8} {spent:6.1f}  {', '.join(places)}"
        print(row, flush=True)
        report[name] = {
            "executions": executions,
            "features": int(counts[-1][1]),
            "cpu_s": round(spent, 1),
            "findings": len(places),
        }
        report["all"] = {"executions": total, "findings": found}
        if args.report is not None:
            args.report.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"{total} executions, {found} findings")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
