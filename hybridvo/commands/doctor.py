"""``hybridvo doctor``: what is installed here, what it runs on, and which methods can run."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from typing import Any

import hybridvo

_OPTIONAL = {
    "poselib": "pip install 'hybridvo[baselines]', for --method poselib",
    "open3d": "pip install open3d, for --method open3d-rgbd",
    "rerun": "pip install 'hybridvo[viz]', for --rrd",
}
"""Import name: command, and what needs it."""


def doctor() -> dict[str, Any]:
    """What a bug report should hold, JSON-ready; ``usable``: whether ``hybridvo run`` can work.

    ``missing``, ``optional`` and ``methods`` map names to the remedy, empty where all is well.
    """
    try:
        lines = [line for line in requires("hybridvo") or [] if "extra ==" not in line]
    except PackageNotFoundError:  # not installed: run from its folder
        lines = []
    packages = {name: _version(name) for name in (re.split(r"[^\w.-]", x)[0] for x in lines)}
    missing = {name: f"pip install {name}" for name, found in packages.items() if not found}
    nothing: dict[str, Any] = {"devices": {}, "threads": {}, "warm_up_s": None, "methods": {}}
    return {
        "hybridvo": hybridvo.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
        "missing": missing,
        "optional": {k: "" if find_spec(k) is not None else how for k, how in _OPTIONAL.items()},
        **(nothing if missing else _what_runs()),
        "usable": not missing,
    }


def doctor_text(report: Mapping[str, Any]) -> str:
    """The report for people."""

    def listed(name: str) -> str:
        return ", ".join(f"{key} {value or 'MISSING'}" for key, value in report[name].items())

    lines = [
        f"hybridvo {report['hybridvo']}, Python {report['python']}, {report['platform']}",
        f"packages   {listed('packages')}",
        f"devices    {listed('devices')}",
        f"threads    {listed('threads')}",
    ]
    if not report["missing"]:
        lines.append(f"warm-up    {report['warm_up_s']:.2f} s before the first frame")
        ready = [name for name, problem in report["methods"].items() if not problem]
        lines.append("methods    " + ", ".join(ready))
    for name, how in report["optional"].items():
        lines.append(f"optional   {name}: {(how and f'not installed; {how}') or 'installed'}")
    lines += [f"MISSING    {name}: {command}" for name, command in report["missing"].items()]
    lines.append("ready" if report["usable"] else "NOT ready: see above")
    return "\n".join(lines)


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        # OpenCV comes in several distributions of the same module
        other = name.startswith("opencv") and find_spec("cv2")
        return "another distribution" if other else None


def _what_runs() -> dict[str, Any]:
    """Devices, threads, time of the first call, and methods."""
    import cv2
    import numba
    import torch

    from hybridvo.estimation import warm_up
    from hybridvo.evaluation.comparison import methods_to_run

    devices = {}
    for name in ("cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))):
        label = name if name == "cpu" else f"{name} ({torch.cuda.get_device_name(name)})"
        try:
            ones = torch.ones(64, 64, device=name)
            works = float((ones @ ones)[0, 0]) == 64.0
            devices[label] = "works" if works else "computes wrongly"
        except RuntimeError as error:
            devices[label] = f"fails: {str(error).splitlines()[0]}"
    ready, absent = methods_to_run(("all",))
    return {
        "devices": devices,
        "threads": {
            "cpus": os.cpu_count(),
            "torch": torch.get_num_threads(),
            "opencv": cv2.getNumThreads(),
            "numba": numba.get_num_threads(),
        },
        "warm_up_s": warm_up(),
        "methods": {**dict.fromkeys(ready, ""), **absent},
    }
