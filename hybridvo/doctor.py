"""``hybridvo doctor``: what is installed here, what it runs on, and what is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import hybridvo

__all__ = ["doctor", "doctor_text"]

_REQUIRED = {
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv-python-headless",
    "numba": "numba",
    "torch": "torch",
    "kornia": "kornia",
    "pypose": "pypose",
    "evo": "evo",
    "safetensors": "safetensors",
    "yaml": "pyyaml",
    "rich": "rich",
    "matplotlib": "matplotlib",
}
_OPTIONAL = {
    "poselib": ("poselib", "pip install 'hybridvo[baselines]'", "--method poselib"),
    "open3d": ("open3d", "pip install open3d", "--method open3d-rgbd"),
    "rerun": ("rerun-sdk", "pip install rerun-sdk", "--rrd"),
}


def doctor() -> dict[str, Any]:
    """What a bug report should hold, JSON-ready.

    Returns:
        ``python``, ``hybridvo``, ``platform``; ``packages`` (name: version or None); ``missing``
        (required packages, each with its pip command); ``optional`` (name: version or the pip
        command and what needs it); ``devices``; ``threads``; ``numba_cache`` (folder, whether it
        can be written, compiled files); ``warm_up_s`` (cost of the first call); ``methods``;
        ``notes``; ``usable`` (whether ``hybridvo run`` can work).
    """
    packages = {name: _version(name, module) for module, name in _REQUIRED.items()}
    missing = {name: f"pip install {name}" for name, found in packages.items() if found is None}
    report: dict[str, Any] = {
        "hybridvo": hybridvo.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
        "missing": missing,
        "optional": {
            name: {"version": _version(name, module), "install": install, "for": purpose}
            for module, (name, install, purpose) in _OPTIONAL.items()
        },
        "notes": [],
        "devices": ["cpu"],
        "threads": {"cpus": os.cpu_count(), "usable": _usable_cpus()},
        "numba_cache": None,
        "warm_up_s": None,
        "methods": {},
    }
    usable = not missing
    if usable:
        for look in (_look_at_devices, _look_at_threads, _look_at_numba_cache, _look_at_methods):
            try:
                look(report)
            except Exception as error:  # a diagnosis goes on where one part of it fails
                usable = False
                report["notes"].append(f"{look.__name__[9:]}: {type(error).__name__}: {error}")
    return report | {"usable": usable}


def doctor_text(report: Mapping[str, Any]) -> str:
    """The report for people."""
    lines = [
        f"hybridvo {report['hybridvo']}, Python {report['python']}, {report['platform']}",
        "packages   " + ", ".join(f"{n} {v or 'MISSING'}" for n, v in report["packages"].items()),
        "devices    " + ", ".join(report["devices"]),
        "threads    " + ", ".join(f"{name} {count}" for name, count in report["threads"].items()),
    ]
    cache = report["numba_cache"]
    if cache:
        state = f"{cache['files']} compiled kernels" if cache["files"] else "empty"
        writable = "" if cache["writable"] else ", cannot be written: every process compiles anew"
        lines.append(f"numba      cache {cache['folder']}: {state}{writable}")
    if report["warm_up_s"] is not None:
        lines.append(f"warm-up    {report['warm_up_s']:.2f} s before the first frame")
    ready = [name for name, problem in report["methods"].items() if not problem]
    if ready:
        lines.append("methods    " + ", ".join(ready))
    for name, entry in report["optional"].items():
        found = entry["version"] or f"not installed; {entry['for']} needs it: {entry['install']}"
        lines.append(f"optional   {name}: {found}")
    lines += [f"MISSING    {name}: {command}" for name, command in report["missing"].items()]
    lines += [f"note       {note}" for note in report["notes"]]
    lines.append("ready" if report["usable"] else "NOT ready: see above")
    return "\n".join(lines) + "\n"


def _version(name: str, module: str) -> str | None:
    """Version of a package that can be found, or None."""
    from importlib.metadata import PackageNotFoundError, version

    if importlib.util.find_spec(module) is None:
        return None
    try:
        return version(name)
    except PackageNotFoundError:  # another distribution of the same module, as with OpenCV
        return str(getattr(importlib.import_module(module), "__version__", "unknown"))


def _usable_cpus() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def _look_at_devices(report: dict[str, Any]) -> None:
    import torch

    for index in range(torch.cuda.device_count()):
        report["devices"].append(f"cuda:{index} {torch.cuda.get_device_name(index)}")
    report["threads"]["torch"] = torch.get_num_threads()


def _look_at_threads(report: dict[str, Any]) -> None:
    import cv2
    import numba

    report["threads"]["opencv"] = cv2.getNumThreads()
    report["threads"]["numba"] = numba.get_num_threads()


def _look_at_numba_cache(report: dict[str, Any]) -> None:
    from hybridvo.pipeline import warm_up

    named = os.environ.get("NUMBA_CACHE_DIR")
    folder = (
        Path(named) if named else Path(__file__).resolve().parent / "refinement" / "__pycache__"
    )
    before = len(list(folder.rglob("*.nbi")))
    started = time.perf_counter()
    warm_up()
    report["warm_up_s"] = time.perf_counter() - started
    present = folder if folder.is_dir() else folder.parent
    report["numba_cache"] = {
        "folder": os.fspath(folder),
        "writable": os.access(present, os.W_OK),
        "files": len(list(folder.rglob("*.nbi"))),
        "files_before": before,
    }


def _look_at_methods(report: dict[str, Any]) -> None:
    from hybridvo.errors import InputError
    from hybridvo.pipeline import METHODS, check_method

    for method in METHODS:
        try:
            check_method(method)
            report["methods"][method] = ""
        except InputError as error:
            report["methods"][method] = str(error)
