"""Build two wheels: one of Python files, for every system, and one with compiled kernels.

    python tools/build_wheel.py --out dist

The second wheel is for this system and this version of Python. Its kernels are compiled for
every processor with the instructions of x86-64-v3, which came with Intel's Haswell (2013) and
AMD's Excavator (2015). They are used where numba is the version that compiled them; elsewhere
numba compiles on the first call, as after an installation of the first wheel.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import wheel_hook
from measuring import ROOT

BASELINES = {"x86_64": "x86-64-v3", "AMD64": "x86-64-v3"}
"""Machine -> processor for which kernels are compiled, as LLVM names it."""
FEATURES = {
    "x86-64-v3": "+64bit,+cmov,+cx8,+fxsr,+mmx,+sse,+sse2"
    ",+cx16,+sahf,+popcnt,+sse3,+ssse3,+sse4.1,+sse4.2,+crc32"
    ",+avx,+avx2,+bmi,+bmi2,+f16c,+fma,+lzcnt,+movbe,+xsave"
}
"""Processor -> its instructions, by level of the x86-64 psABI, as LLVM names them."""
MAX_MEGABYTES = 20


class BuildError(Exception):
    """The wheel cannot be built here."""


def baseline() -> str:
    """The processor for which kernels are compiled on this kind of machine."""
    machine = platform.machine()
    if machine not in BASELINES:
        known = ", ".join(sorted(BASELINES))
        raise BuildError(
            f"no baseline processor is known for {machine}, only for {known}: "
            "pass --pure for the wheel of Python files."
        )
    return BASELINES[machine]


def check_compiler() -> None:
    """Refuse a compiler whose code runs only beside libraries that others lack."""
    from numba.core import config

    if config.USING_SVML:
        raise BuildError(
            "numba found Intel's SVML here, which its code would need everywhere: "
            "remove icc_rt."
        )


def wheel_tag() -> str:
    """Python, ABI and system: what runs this llvmlite runs what it compiled.

    >>> wheel_tag()  # doctest: +SKIP
    'cp311-cp311-manylinux_2_27_x86_64.manylinux_2_28_x86_64'
    """
    text = distribution("llvmlite").read_text("WHEEL") or ""
    lines = text.splitlines()
    tags = [
        line.removeprefix("Tag: ") for line in lines if line.startswith("Tag: ")
    ]
    python, abi, _ = tags[0].split("-")
    systems = sorted({tag.split("-")[2] for tag in tags})
    return f"{python}-{abi}-{'.'.join(systems)}"


def compiling_for(cpu: str) -> dict[str, str]:
    """The environment in which numba compiles for a processor."""
    return os.environ | {
        "NUMBA_CPU_NAME": cpu,
        "NUMBA_CPU_FEATURES": FEATURES[cpu],
    }


def build(out: Path, extra: dict[str, str]) -> Path:
    """Build a wheel with hatchling; its path."""
    with tempfile.TemporaryDirectory(dir=out) as folder:
        command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel"]
        subprocess.run(
            [*command, "-d", folder],
            cwd=ROOT,
            env=os.environ | extra,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        (path,) = Path(folder).iterdir()
        return path.replace(out / path.name)


def compile_kernels(pure: Path, work: Path, cpu: str) -> Path:
    """Compile the kernels of a wheel, which is unpacked for that; their folder."""
    unpacked = work / "unpacked"
    with zipfile.ZipFile(pure) as archive:
        archive.extractall(unpacked)
    compiled = work / "compiled"
    cache = work / "cache"
    cache.mkdir()
    environment = compiling_for(cpu) | {
        "PYTHONPATH": str(unpacked),
        "NUMBA_CACHE_DIR": str(cache),
    }
    script = Path(__file__).with_name("kernel_calls.py")
    subprocess.run(
        [sys.executable, str(script), "--out", str(compiled)],
        cwd=work,
        env=environment,
        check=True,
    )
    return compiled


def build_compiled(pure: Path, out: Path) -> Path:
    """Build the wheel with compiled kernels; its path."""
    cpu = baseline()
    check_compiler()
    with tempfile.TemporaryDirectory() as work:
        compiled = compile_kernels(pure, Path(work), cpu)
        return build(
            out,
            {
                wheel_hook.FOLDER_VARIABLE: str(compiled),
                wheel_hook.TAG_VARIABLE: wheel_tag(),
            },
        )


def main(argv: list[str] | None = None) -> int:
    """Build, and print the wheels with their sizes."""
    paragraph = (__doc__ or "").split("\n\n")[0]
    parser = argparse.ArgumentParser(description=paragraph)
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    parser.add_argument("--pure", action="store_true", help="the first wheel alone")
    args = parser.parse_args(argv)
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    try:
        wheels = [build(out, {})]
        if not args.pure:
            wheels.append(build_compiled(wheels[0], out))
    except BuildError as error:
        print(f"build_wheel.py: {error}", file=sys.stderr)
        return 2
    for path in wheels:
        megabytes = path.stat().st_size / 1e6
        print(f"{path}: {megabytes:.1f} MB")
        if megabytes > MAX_MEGABYTES:
            print(f"build_wheel.py: more than {MAX_MEGABYTES} MB", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
