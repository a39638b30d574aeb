"""``hybridvo doctor``: what is installed here, what it runs on, and which methods can run."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from typing import Any

import hybridvo

_OPTIONAL = {
    "poselib": ("pip install 'hybridvo[baselines]'", "--method poselib"),
    "open3d": ("pip install open3d", "--method open3d-rgbd"),
    "rerun": ("pip install 'hybridvo[viz]'", "--rrd"),
}
"""Import name: command, and what needs it."""


def doctor() -> dict[str, Any]:
    """What a bug report should hold, JSON-ready.

    Returns:
        ``hybridvo``, ``python``, ``platform``; ``packages`` (name: version or None); ``missing``
        (required packages, each with its pip command); ``optional``; ``devices`` (name: ``works``
        or the error); ``threads``; ``warm_up_s`` (cost of the first call); ``methods`` (name: empty
        or why it cannot run); ``usable`` (whether ``hybridvo run`` can work).
    """
    packages = {name: _version(name) for name in _required()}
    missing = {name: f"pip install {name}" for name, found in packages.items() if not found}
    optional = {
        name: {"installed": find_spec(name) is not None, "install": install, "for": purpose}
        for name, (install, purpose) in _OPTIONAL.items()
    }
    return {
        "hybridvo": hybridvo.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
        "missing": missing,
        "optional": optional,
        **(
            {"devices": {}, "threads": {}, "warm_up_s": None, "methods": {}}
            if missing
            else _what_runs()
        ),
        "usable": not missing,
    }


def doctor_text(report: Mapping[str, Any]) -> str:
    """The report for people."""
    packages = (f"{name} {found or 'MISSING'}" for name, found in report["packages"].items())
    lines = [
        f"hybridvo {report['hybridvo']}, Python {report['python']}, {report['platform']}",
        "packages   " + ", ".join(packages),
        "devices    " + ", ".join(f"{name} {state}" for name, state in report["devices"].items()),
        "threads    " + ", ".join(f"{name} {count}" for name, count in report["threads"].items()),
    ]
    if report["warm_up_s"] is not None:
        lines.append(f"warm-up    {report['warm_up_s']:.2f} s before the first frame")
    ready = [name for name, problem in report["methods"].items() if not problem]
    if ready:
        lines.append("methods    " + ", ".join(ready))
    for name, entry in report["optional"].items():
        missing = f"not installed; {entry['for']} needs it: {entry['install']}"
        lines.append(f"optional   {name}: {'installed' if entry['installed'] else missing}")
    lines += [f"MISSING    {name}: {command}" for name, command in report["missing"].items()]
    lines.append("ready" if report["usable"] else "NOT ready: see above")
    return "\n".join(lines)


def _required() -> list[str]:
    """Names of the packages that hybridvo requires, from its own metadata."""
    try:
        lines = requires("hybridvo") or []
    except PackageNotFoundError:  # not installed: run from its folder
        return []
    names = (line.split(";")[0] for line in lines if "extra ==" not in line)
    return ["".join(c if c.isalnum() or c in "-_." else " " for c in n).split()[0] for n in names]


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        # OpenCV comes in several distributions of the same module
        other = name.startswith("opencv") and find_spec("cv2")
        return "another distribution" if other else None


def _devices() -> dict[str, str]:
    """Device and ``works``, or what went wrong in a small product of matrices."""
    import torch

    found = {}
    for name in ("cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))):
        try:
            ones = torch.ones(64, 64, device=name)
            state = "works" if float((ones @ ones)[0, 0]) == 64.0 else "computes wrongly"
        except RuntimeError as error:
            state = f"fails: {str(error).splitlines()[0]}"
        label = name if name == "cpu" else f"{name} ({torch.cuda.get_device_name(name)})"
        found[label] = state
    return found


def _what_runs() -> dict[str, Any]:
    """Devices, threads, time of the first call, and methods."""
    import cv2
    import numba
    import torch

    from hybridvo.estimation import warm_up
    from hybridvo.evaluation.plan import methods_to_run

    ready, absent = methods_to_run(("all",))
    return {
        "devices": _devices(),
        "threads": {
            "cpus": os.cpu_count(),
            "torch": torch.get_num_threads(),
            "opencv": cv2.getNumThreads(),
            "numba": numba.get_num_threads(),
        },
        "warm_up_s": warm_up(),
        "methods": {**dict.fromkeys(ready, ""), **absent},
    }
