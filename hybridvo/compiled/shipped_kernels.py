"""Kernels that a platform wheel brings along, compiled when the wheel was built.

``tools/build_wheel.py`` makes them: files of numba's cache for a processor with the
instructions of x86-64-v3. A machine of these or more instructions loads them, where
Python, numba and the sources are those of the build. Everything else compiles.
"""

from __future__ import annotations

import functools
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FunctionType
from typing import Any

import llvmlite
import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

from hybridvo.compiled.kernel_sources import dependencies

PACKAGE = Path(__file__).parent.parent
"""The folder of the package."""
FOLDER = PACKAGE / "compiled" / "kernels"
"""The files of the kernels, in the folders of the package; only in a platform wheel."""
STATED = "build.json"
"""File of the folder that states for what its kernels were compiled."""


@dataclass(frozen=True)
class Build:
    """For what kernels were compiled.

    Attributes:
        python: version, such as ``3.11``.
        numba: version.
        llvmlite: version.
        triple: system, as LLVM names it.
        cpu: processor, as LLVM names it.
        features: instructions that the code may contain, as LLVM names them:
            ``+avx,+avx2``.
    """

    python: str
    numba: str
    llvmlite: str
    triple: str
    cpu: str
    features: str

    def magic_tuple(self) -> tuple[str, str, str]:
        """Return what numba's key states about the processor."""
        return self.triple, self.cpu, self.features

    def obstacle(self, here: Build) -> str:
        """State why the code cannot run on another machine; empty if it can."""
        for name in ("python", "numba", "llvmlite", "triple"):
            own = getattr(self, name)
            other = getattr(here, name)
            if own != other:
                return f"those of the wheel are for {name} {own}, here is {other}"
        missing = instructions(self.features) - instructions(here.features)
        if missing:
            text = ", ".join(sorted(missing))
            return f"those of the wheel need a processor with {text}"
        return ""


def instructions(features: str) -> set[str]:
    """Return the names of the features that are present.

    >>> sorted(instructions("+avx,-sse4a,+fma"))
    ['avx', 'fma']
    """
    return {name[1:] for name in features.split(",") if name.startswith("+")}


def build_here(codegen: Any) -> Build:
    """Return for what numba compiles in this process.

    Args:
        codegen: numba's generator of code.
    """
    triple, cpu, features = codegen.magic_tuple()
    return Build(
        python=f"{sys.version_info.major}.{sys.version_info.minor}",
        numba=numba.__version__,
        llvmlite=llvmlite.__version__,
        triple=triple,
        cpu=cpu,
        features=features,
    )


def read_build(folder: Path) -> Build | None:
    """Read for what the kernels of a folder were compiled; None if that is not stated."""
    try:
        text = (folder / STATED).read_text(encoding="utf-8")
        return Build(**json.loads(text))
    # there are no kernels, or the file is damaged
    except (OSError, ValueError, TypeError):
        return None


def write_build(folder: Path, build: Build) -> None:
    """State for what the kernels of a folder were compiled."""
    text = json.dumps(asdict(build), indent=1)
    (folder / STATED).write_text(text + "\n", encoding="utf-8")


def folder_of(source: str) -> Path:
    """Return the folder of the package that holds a source, relative to the package."""
    folder = Path(source).resolve().parent
    return folder.relative_to(PACKAGE.resolve())


class _ShippedLocator(_CacheLocator):
    """Where numba finds the files of a kernel."""

    def __init__(self, function: FunctionType, source: str) -> None:
        self._function = function
        self._folder = FOLDER / folder_of(source)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder is only read."""

    def get_cache_path(self) -> str:
        """Return the folder of the kernel's files."""
        return str(self._folder)

    def get_source_stamp(self) -> tuple[str, ...]:
        """Return what the kernel is made of."""
        return dependencies(self._function)

    def get_disambiguator(self) -> str:
        """Return the line of the kernel, which is part of the names of its files."""
        return str(self._function.__code__.co_firstlineno)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        """Make the locator of a kernel; None if the kernel is not of the package."""
        try:
            return cls(py_func, py_file)
        except ValueError:
            return None


class _ShippedFiles(CompileResultCacheImpl):
    _locator_classes = [_ShippedLocator]  # noqa: RUF012


class ShippedKernel(FunctionCache):
    """The machine code of one kernel in the wheel, for numba to load.

    Args:
        function: the kernel.
        build: for what the wheel's kernels were compiled.

    Raises:
        RuntimeError: the kernel is not of the package.
    """

    _impl_class = _ShippedFiles

    def __init__(self, function: FunctionType, build: Build) -> None:
        super().__init__(function)
        self._build = build

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the code for a signature; None where it cannot run here or is missing."""
        here = build_here(target_context.codegen())
        if self._build.obstacle(here):
            return None
        try:
            return super().load_overload(sig, target_context)
        # damaged; pickle and LLVM raise all kinds of errors
        except Exception:
            return None

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Return whether there is code for a signature that can run here."""
        codegen = target_context.codegen()
        if self._build.obstacle(build_here(codegen)):
            return False
        return holds(self, sig, codegen)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Do nothing: the wheel's files stay as they are."""

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        """Numba's key of a signature, for the processor of the build."""
        return super()._index_key(sig, self._build)


def holds(cache: FunctionCache, sig: Any, codegen: Any) -> bool:
    """Return whether a cache of numba's lists code for a signature."""
    try:
        return cache._index_key(sig, codegen) in cache._cache_file._load_index()
    # damaged; pickle raises all kinds of errors
    except Exception:
        return False


@functools.cache
def shipped_build() -> Build | None:
    """Return for what the kernels of this installation were compiled, None without any."""
    return read_build(FOLDER)


def shipped_kernel(function: FunctionType) -> ShippedKernel | None:
    """Return the machine code of a kernel in the wheel, None where there is none."""
    build = shipped_build()
    if build is None:
        return None
    try:
        return ShippedKernel(function, build)
    except RuntimeError:
        return None


def kernels_in_use() -> str:
    """State where the machine code of the kernels comes from."""
    from numba.core.registry import cpu_target

    build = shipped_build()
    if build is None:
        return "compiled on this machine"
    why = build.obstacle(build_here(cpu_target.target_context.codegen()))
    if why:
        return f"compiled on this machine: {why}"
    return f"from the wheel, for every {build.cpu}"
