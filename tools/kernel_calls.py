"""Compile the kernels of the imported package into a folder, for a platform wheel.

    NUMBA_CACHE_DIR=empty python tools/kernel_calls.py --out compiled
    NUMBA_CACHE_DIR=empty python tools/kernel_calls.py --signatures

``tools/build_wheel.py`` calls it, with the processor for which numba is to compile in the
environment. Each kernel is called with arrays of the types that the package passes.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.caching import UserProvidedCacheLocator
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

import hybridvo
from hybridvo.compiled.ahead_of_time import (
    Table,
    compile_ahead,
    describe_type,
    write_table,
)
from hybridvo.compiled.shipped_kernels import PACKAGE, build_here, write_build


def call_all() -> None:
    """Call what compiles."""
    from hybridvo.run.commands.doctor import call_kernels

    call_kernels()
    register()
    decode()


def register() -> None:
    """Move depth into another camera."""
    from hybridvo.io.data.registration import register_depth

    camera = hybridvo.Camera(fx=10.0, fy=10.0, cx=1.0, cy=0.0, height=1, width=3)
    register_depth(np.float32([[2.0, 2.0, 0.0]]), camera, np.eye(4), camera)


def decode() -> None:
    """Decode depth of a bag of ROS: one pixel."""
    from hybridvo.io.data.bags.rvl import decode_rvl

    decode_rvl(struct.pack("<iiI", 1, 1, 0x01200000), "kernel_calls")


# --- what was compiled ----------------------------------------------------------------------------


def modules(package: Any) -> Iterator[Any]:
    """The modules of a package that can be imported here."""
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if found.name.endswith("__main__"):
            continue
        try:
            yield importlib.import_module(found.name)
        # of an extra that is not installed
        except (ImportError, hybridvo.InputError):
            continue


def kernels(package: Any = hybridvo) -> dict[str, Dispatcher]:
    """All kernels of a package, by module and variable: ``module:name``."""
    found: dict[int, str] = {}
    by_name = {}
    for module in modules(package):
        for variable, value in vars(module).items():
            if not (isinstance(value, Dispatcher) and hasattr(value, "_cache")):
                continue
            name = f"{module.__name__}:{variable}"
            # others import it from there
            is_at_home = value.py_func.__module__ == module.__name__
            if is_at_home or id(value) not in found:
                by_name.pop(found.get(id(value), ""), None)
                found[id(value)] = name
                by_name[name] = value
    return by_name


def never_called() -> list[str]:
    """Names of the kernels that no call has compiled: their users wait for the compiler."""
    names = [
        f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"
        for kernel in kernels().values()
        if not kernel.overloads
    ]
    return sorted(names)


def signatures(package: Any) -> Table:
    """The types for which each kernel of a package was compiled, or loaded, in this process."""
    return {
        name: [
            [describe_type(argument) for argument in signature]
            for signature in kernel.overloads
        ]
        for name, kernel in kernels(package).items()
        if kernel.overloads
    }


def collect(package: Path, cache: Path, out: Path) -> int:
    """Copy numba's files into folders like those of the package.

    Args:
        package: the folder of the sources.
        cache: numba's folder.
        out: the folder to write.

    Returns:
        How many kernels there are, each with its types.
    """
    out.mkdir(parents=True)
    folders = {source.parent for source in package.rglob("*.py")}
    for folder in sorted(folders):
        any_source = str(folder / "__init__.py")
        name = UserProvidedCacheLocator.get_suitable_cache_subpath(any_source)
        if (cache / name).is_dir():
            below = out / folder.relative_to(package)
            shutil.copytree(cache / name, below, dirs_exist_ok=True)
    write_build(out, build_here(cpu_target.target_context.codegen()))
    return len(list(out.rglob("*.nbc")))


def main(argv: list[str] | None = None) -> int:
    """Compile, and write the folder."""
    parser = argparse.ArgumentParser(
        description="Compile the kernels of the package."
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--out", type=Path, help="folder for a platform wheel")
    what.add_argument(
        "--signatures",
        action="store_true",
        help="write the tables for hybridvo.compiled.ahead_of_time instead",
    )
    args = parser.parse_args(argv)
    if args.signatures:
        import hybridvo_lab
        from hybridvo_lab.commands.demo import demo_frames

        call_all()
        demo_frames(2)
        write_table(signatures(hybridvo))
        write_table(signatures(hybridvo_lab), hybridvo_lab.KERNELS)
        return 0
    compile_ahead()
    call_all()
    count = collect(PACKAGE, Path(os.environ["NUMBA_CACHE_DIR"]), args.out)
    print(f"{count} kernels compiled")
    for name in never_called():
        print(f"not called: {name}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
