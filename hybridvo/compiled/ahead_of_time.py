"""Kernels that are compiled before they are called, in as many processes as there are cores.

Numba compiles a kernel when it is called, one after the other. Here the types of all calls
are known beforehand, from a table that ``tools/kernel_calls.py`` writes. The machine
code goes into numba's cache, from which every later process loads it.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import logging
import multiprocessing
import os
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from numba.core import types
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

from hybridvo.compiled.kernel_cache import KernelCache
from hybridvo.compiled.kernel_sources import kernels_called

_logger = logging.getLogger(__name__)
Table = dict[str, list[list[Any]]]
"""Kernel, as ``module:name`` -> its signatures, each a list of described types."""
TABLE = Path(__file__).with_name("signatures.json")
"""The file of the table."""
SIMPLE_TYPES = {
    str(numba_type): numba_type
    for numba_type in (types.boolean, types.npy_rng, *types.number_domain)
}
"""Types that a name states."""


def compile_ahead(jobs: int | None = None, path: Path = TABLE) -> int:
    """Compile the kernels of the table that are not in the cache.

    A kernel waits for those that it calls: else two processes would compile these.

    Args:
        jobs: how many processes; None: as many as there are cores.
        path: of the table.

    Returns:
        How many kernels were compiled.
    """
    jobs = jobs or os.cpu_count() or 1
    table = read_table(path)
    kernels = {name: find_kernel(name) for name in table}
    missing = {
        name: table[name]
        for name in kernels
        if not is_kept(kernels[name], table[name])
    }
    if not missing:
        return 0
    _logger.warning(
        "hybridvo: compiling %d kernels in %d processes", len(missing), jobs
    )
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, initializer=_be_quiet)
    # what a process that died has not compiled is compiled when it is called
    with contextlib.suppress(BrokenProcessPool), pool:
        _compile_in(pool, callees(kernels), missing)
    return len(missing)


def read_table(path: Path = TABLE) -> Table:
    """Read the signatures of all kernels."""
    return json.loads(path.read_text(encoding="utf-8"))


def find_kernel(name: str) -> Dispatcher:
    """Return the kernel of a name ``module:name``."""
    module, _, variable = name.partition(":")
    return getattr(importlib.import_module(module), variable)


def is_kept(kernel: Any, signatures: list[list[Any]]) -> bool:
    """Return whether no process need compile a kernel for others.

    It is in the cache, or in the wheel; or there is no folder for it, or numba is
    switched off (``NUMBA_DISABLE_JIT``).
    """
    cache = getattr(kernel, "_cache", None)
    if not isinstance(kernel, Dispatcher) or not isinstance(cache, KernelCache):
        return True
    return all(
        cache.holds(read_signature(signature), cpu_target.target_context)
        for signature in signatures
    )


def callees(kernels: dict[str, Dispatcher]) -> dict[str, list[str]]:
    """Return which kernels of the table each of them calls."""
    name_of = {id(kernel.py_func): name for name, kernel in kernels.items()}
    return {
        name: [
            name_of[id(called)]
            for called in kernels_called(kernel)
            if id(called) in name_of
        ]
        for name, kernel in kernels.items()
    }


def _compile_in(
    pool: ProcessPoolExecutor, calls: dict[str, list[str]], missing: Table
) -> None:
    """Compile kernels in several processes, each after those that it calls."""
    order = TopologicalSorter(calls)
    order.prepare()
    running: dict[Future[None], str] = {}
    while order.is_active():
        for name in order.get_ready():
            if name in missing:
                future = pool.submit(compile_kernel, name, missing[name])
                running[future] = name
            else:
                order.done(name)
        if not running:
            continue
        finished, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            future.result()
            order.done(running.pop(future))


def compile_kernel(name: str, signatures: list[list[Any]]) -> None:
    """Compile a kernel for each of its signatures; its cache keeps the code."""
    kernel = find_kernel(name)
    for signature in signatures:
        kernel.compile(read_signature(signature))


def _be_quiet() -> None:
    """Leave it to the first process to say that kernels are compiled."""
    logging.getLogger("hybridvo").setLevel(logging.ERROR)


# -- types as text ---------------------------------------------------------------------


def read_signature(signature: list[Any]) -> tuple[Any, ...]:
    """Return numba's types of the arguments of a kernel."""
    return tuple(read_type(described) for described in signature)


def read_type(described: Any) -> Any:
    """Return the type that :func:`describe_type` described."""
    if isinstance(described, int):
        return types.literal(described)
    if isinstance(described, str):
        return SIMPLE_TYPES[described]
    kind, *parts = described
    if kind == "array":
        dtype, dimensions, layout, is_readonly = parts
        return types.Array(SIMPLE_TYPES[dtype], dimensions, layout, is_readonly)
    of_entries = tuple(read_type(part) for part in parts)
    named_tuple = None if kind == "tuple" else find_kernel(kind)
    return types.BaseTuple.from_types(of_entries, named_tuple)


def describe_type(numba_type: Any) -> Any:
    """Return a type as JSON has it.

    A number for a literal, a name for a simple type; else a list: ``array`` with the
    type of its entries, dimensions, layout, and whether it is read-only; ``tuple``, or
    ``module:class`` of a named one, with the types of its entries.
    """
    if isinstance(numba_type, types.IntegerLiteral):
        return numba_type.literal_value
    if isinstance(numba_type, types.Array):
        readonly = not numba_type.mutable
        return [
            "array",
            str(numba_type.dtype),
            numba_type.ndim,
            numba_type.layout,
            readonly,
        ]
    if isinstance(numba_type, types.BaseTuple):
        kind = "tuple"
        named = getattr(numba_type, "instance_class", tuple)
        if named is not tuple:
            kind = f"{named.__module__}:{named.__qualname__}"
        entries = numba_type.types  # type: ignore[attr-defined]
        return [kind, *(describe_type(entry) for entry in entries)]
    return str(numba_type)


def write_table(table: Table, path: Path = TABLE) -> None:
    """Write the signatures of all kernels, each on a line of its own."""
    blocks = []
    for name in sorted(table):
        lines = sorted(json.dumps(signature) for signature in table[name])
        signatures = ",\n  ".join(lines)
        blocks.append(f" {json.dumps(name)}: [\n  {signatures}\n ]")
    text = ",\n".join(blocks)
    path.write_text(f"{{\n{text}\n}}\n", encoding="utf-8")
