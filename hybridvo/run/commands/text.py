"""What each command prints for people; with ``--json`` it prints its content instead."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hybridvo.core import laboratory
from hybridvo.run.commands.terminal import printable_content, table

Content = Mapping[str, Any]
"""The result of a command, JSON-ready."""
LABEL_WIDTH = 17
"""Width of the labels before the texts of ``run`` and ``evaluate``, characters."""
FINDING_WIDTH = 12
"""Width of the states before the findings of ``doctor``, characters."""
PLATFORM_WIDTH = 11
"""Width of the labels of ``doctor`` without a sequence, characters."""
MAX_UNREADABLE = 5
"""Unreadable frames that ``doctor`` lists."""
FINDING_STATES = {
    "agrees": "ok",
    "differs": "DIFFERS",
    "cannot_tell": "cannot tell",
}
"""How a finding of ``doctor`` begins."""


def text_of(command: str, content: Content) -> str:
    """Return the result of a command for people.

    Args:
        command: Name of the command.
        content: Its result. Texts in it may come from strangers.

    Returns:
        Lines for the terminal; empty where there is nothing but JSON.
    """
    write = WRITERS.get(command) or laboratory.find(laboratory.TEXTS, command)
    write = write or _files_text
    return "\n".join(write(printable_content(content)))


def _files_text(content: Content) -> list[str]:
    """List the files that a command has written."""
    return [*content.get("files", ())]


def _init_text(content: Content) -> list[str]:
    """Name the file to fill in, and the steps after that."""
    (path,) = content["files"]
    folder = path.rpartition("camera.yaml")[0].rstrip("/") or "."
    return [
        path,
        f"next:  fill it in; put images into {folder}/rgb, depth into {folder}/depth",
        f"       hybridvo doctor {folder}    checks both",
        f"       hybridvo run {folder}",
    ]


def _labelled(label: str, text: str) -> str:
    """Return a line with a label before a text."""
    return f"{label:<{LABEL_WIDTH}}  {text}"


# -- run and evaluate --------------------------------------------------------------------


def _run_text(content: Content) -> list[str]:
    """Describe a run: what was tracked, what failed, and its errors."""
    flow = ", ".join(content["flow_source"]) or "not used"
    lines = [
        _labelled("sequence", f"{content['sequence']}, {content['frames']} frames"),
        _labelled("method", content["method"]),
        _labelled("inputs", f"flow: {flow}; depth: {content['depth_source']}"),
    ]
    if content.get("frame"):
        lines.append(_labelled("path of", f"'{content['frame']}' (trajectory.tum)"))
    if content["oracle"]:
        oracle = " and ".join(content["oracle"])
        lines.append(_labelled("ORACLE", f"uses {oracle} (ground truth)"))
    failed = f"failed {content['failed']} of {content['motions']} motions"
    lines.append(_labelled("status", f"{failed}, {content['degraded']} degraded"))
    lines += [_labelled("doubt", warning) for warning in content["doubts"]]
    if content.get("readout_ms"):
        text = _readout_text(content)
        if content["passes"] == 1:
            text = f"{text}; --passes 3 takes it out"
        lines.append(_labelled("rolling shutter", text))
    if content["frame_ms_median"] is not None:
        lines.append(_labelled("time", _time_text(content)))
    if content["metrics"]:
        lines += _run_errors(content["metrics"])
    lines += _warnings(content)
    lines.append(_labelled("results", content["out"]))
    recording = content.get("recording")
    if recording:
        text = f"{recording} (open it with: rerun FILE)"
        lines.append(_labelled("recording", text))
    export = content.get("export")
    if export:
        text = f"{export['folder']} ({', '.join(export['kinds'])})"
        lines.append(_labelled("export", text))
    if content.get("likely"):
        likely = content["likely"]
        lines.append(_labelled("likely cause", likely["cause"]))
        lines.append(_labelled("try", likely["command"]))
    if content.get("next"):
        lines += _next(content["least_sure"], content["next"])
    return lines


def _readout_text(content: Content) -> str:
    """State how long the rows of an image take, by what the images show."""
    readout = f"{content['readout_ms']:.0f} +- {content['readout_std_ms']:.0f} ms"
    return f"{readout} from the first row to the last, by turns of the camera"


def _next(least_sure: Content, command: str) -> list[str]:
    """Name the least sure motion, and the command that shows it."""
    status = least_sure["status"]
    if least_sure["reason"]:
        status += f" ({least_sure['reason']})"
    probability = f"probability {least_sure['probability']:.3f}"
    frame = f"frame {least_sure['frame']}, {status}, {probability}"
    return [_labelled("least sure", frame), _labelled("next", command)]


def _live_text(content: Content) -> list[str]:
    """Describe a live run: what was tracked, what was dropped, and how old poses were."""
    tracked = f"{content['tracked']} frames, {content['dropped']} dropped"
    width, height = content["size"]
    lines = [
        _labelled("camera", f"{content['camera']}, {tracked}"),
        _labelled("method", f"{content['method']}, images of {width}x{height}"),
        _labelled("ended", content["ended"]),
    ]
    motions = max(content["tracked"] - 1, 0)
    failed = f"failed {content['failed']} of {motions} motions"
    lines.append(_labelled("status", f"{failed}, {content['degraded']} degraded"))
    lines += [_labelled("doubt", text) for text in content["doubts"]]
    if content["dropped"]:
        lines.append(_labelled("dropped", _dropped_text(content)))
    if content["help"]:
        lines.append(_labelled("what helps", content["help"]))
    if content["frames_per_second"] is not None:
        rate = f"{content['frames_per_second']:.1f} frames/s"
        lines.append(_labelled("rate", rate))
    if content.get("readout_ms"):
        lines.append(_labelled("rolling shutter", _readout_text(content)))
    if content["unusable"]:
        lines.append(_labelled("unusable", f"{content['unusable']} frames"))
    p50 = content["age_ms_p50"]
    p95 = content["age_ms_p95"]
    lines.append(_labelled("age of a pose", f"p50 {p50:.0f} ms, p95 {p95:.0f} ms"))
    lines += _warnings(content)
    lines.append(_labelled("results", content["out"]))
    return lines


def _dropped_text(content: Content) -> str:
    """State why frames of a camera were not tracked."""
    causes = {
        "a newer one came while another was tracked": content["replaced"],
        "never came from the camera": content["missed"],
        "too old when their turn came": content["old"],
    }
    parts = [f"{count}: {cause}" for cause, count in causes.items() if count]
    return "; ".join(parts)


def _warnings(content: Content) -> list[str]:
    """List the warnings; of those that were shown when they arose, the number."""
    shown = content.get("warnings_shown", 0)
    lines = [_labelled("warning", text) for text in content["warnings"][shown:]]
    if shown:
        lines.insert(
            0, _labelled("warnings", f"{shown}, shown above and kept in run.json")
        )
    return lines


def _time_text(content: Content) -> str:
    """Describe how long a frame took."""
    frame = content["frame_ms_median"]
    flow = content["flow_ms_median"]
    motion = content["motion_ms_median"]
    return f"{frame:.1f} ms a frame: flow {flow:.1f}, motion {motion:.1f}"


def _run_errors(metrics: Content) -> list[str]:
    """Describe the errors of a run's path and of its motions."""
    return [
        *_path_errors(metrics),
        _error(
            metrics,
            "rotation error",
            "rot_err_deg_median",
            1,
            "deg, median of the pairs",
        ),
        _error(
            metrics,
            "translation error",
            "trans_err_median",
            100,
            "cm, median of the pairs",
        ),
        _error(metrics, "ego-flow error", "epe_l2_px", 1, "px, mean of the pairs"),
    ]


def _evaluate_text(content: Content) -> list[str]:
    """Describe the errors of a trajectory."""
    if "protocol" in content:
        return _protocol_text(content)
    matched = f"{content['matched']} of {content['total']} poses"
    lines = [
        _labelled("matched", f"{matched}, by {content['matched_by']}"),
        *_path_errors(content),
        _error(content, "ATE unaligned", "ate_rmse_unaligned", 100, "cm RMSE"),
    ]
    drift = content["kitti_drift"]
    if drift:
        percent = 100 * drift["translation"]
        rotation = drift["rotation_deg_per_m"]
        text = f"{percent:.4g} %, {rotation:.4g} deg/m"
        lines.append(_labelled("KITTI drift", text))
    lines += [_labelled("warning", warning) for warning in content["warnings"]]
    return lines


def _protocol_text(content: Content) -> list[str]:
    """Describe the errors of a trajectory as a protocol defines them."""
    matched = f"{content['matched']} poses of {content['total']} true ones"
    lines = [
        _labelled("protocol", f"{content['protocol']}: {content['title']}"),
        _labelled("matched", f"{matched}, aligned: {content['alignment']}"),
    ]
    for figure in ("ate", "rpe_t", "rpe_r"):
        columns = [row for row in content["columns"] if row[0].startswith(figure)]
        if columns:
            _, label, factor = columns[0]
            unit = label[label.index("[") + 1 : -1]
            name = label.split()[0]
            lines.append(_error(content, name, figure, factor, unit))
    return lines + [_labelled("warning", text) for text in content["warnings"]]


def _path_errors(report: Content) -> list[str]:
    """Describe the absolute and relative errors of a path."""
    span = f"RMSE over {report['delta']:g} {report['delta_unit']}"
    alignment = f"cm RMSE ({report['alignment']})"
    return [
        _error(report, "ATE", "ate_rmse", 100, alignment),
        _error(report, "RPE translation", "rpe_trans_rmse", 100, f"cm {span}"),
        _error(report, "RPE rotation", "rpe_rot_rmse_deg", 1, f"deg {span}"),
    ]


def _error(report: Content, label: str, key: str, factor: float, unit: str) -> str:
    """Return a line with an error, or with the reason why it is not known."""
    value = report[key]
    if value is None:
        return _labelled(label, f"- ({report['reasons'].get(key, 'unknown')})")
    return _labelled(label, f"{factor * value:.4g} {unit}")


# -- methods that cannot run ------------------------------------------------------------


def reasons_of(missing: Mapping[str, str]) -> list[str]:
    """Return why methods cannot run, those with the same reason in one line.

    Args:
        missing: The reason of each method, which may begin with its name.

    >>> reasons_of({"a": "a: no weights.", "b": "b: no weights.", "c": "no GPU."})
    ['a, b: no weights.', 'c: no GPU.']
    """
    names: dict[str, list[str]] = {}
    for name, reason in missing.items():
        reason = reason.removeprefix(f"{name}: ")
        reason = reason.removeprefix(f"method '{name}' cannot run here: ")
        names.setdefault(reason, []).append(name)
    return [f"{', '.join(group)}: {reason}" for reason, group in names.items()]


# -- doctor ------------------------------------------------------------------------------


def _doctor_text(content: Content) -> list[str]:
    """Describe what is wrong with a sequence, how fast it is, or what is installed."""
    if "stages" in content:
        return _speed_text(content)
    if "findings" not in content:
        return _platform_text(content)
    findings = content["findings"]
    lines = [
        f"{content['sequence']}: {content['frames']} frames, "
        f"{content['pairs']} pairs looked at"
    ]
    for finding in findings:
        state = FINDING_STATES[finding["state"]]
        text = f"{finding['name']}: {finding['message']}"
        lines.append(f"{state:<{FINDING_WIDTH}}{text}")
    for message in content["unreadable"][:MAX_UNREADABLE]:
        lines.append(f"{'unreadable':<{FINDING_WIDTH}}{message}")
    for message in content["warnings"]:
        lines.append(f"{'warning':<{FINDING_WIDTH}}{message}")
    lines.append(f"{'not checked':<{FINDING_WIDTH}}{content['not_checked']}")
    if any(finding["state"] == "differs" for finding in findings):
        verdict = "something differs: see above"
    elif content["unreadable"]:
        verdict = f"{len(content['unreadable'])} files or frames cannot be read: see above"
    else:
        verdict = "nothing differs"
    unanswered = sum(finding["state"] == "cannot_tell" for finding in findings)
    if unanswered:
        verdict += (
            f"; {unanswered} of {len(findings)} questions could not be answered"
        )
    lines.append(verdict)
    return lines


def _speed_text(content: Content) -> list[str]:
    """Describe how fast frames are tracked, and what their time goes to."""
    width, height = content["size"]
    rate = f"{content['frames_per_second']:.1f} frames a second"
    load = "unknown" if content["load"] is None else f"{content['load']:.1f}"
    return [
        f"{content['sequence']}: {content['motions']} motions, {width}x{height}, "
        f"{content['method']}: {rate}",
        f"{content['cores']} cores, load {load}",
        "",
        *stage_lines(content["stages"], content["motions"], content["frame_ms"]),
    ]


def stage_lines(stages: Content, motions: int, frame_ms: Content) -> list[str]:
    """Return a table of what the time of a frame goes to.

    Args:
        stages: The median and the 95th percentile of each stage.
        motions: How many frames were tracked.
        frame_ms: The same of a whole frame, without its reading.
    """
    whole = {"frames": motions, **frame_ms}
    rows = [
        {
            "stage": name,
            "median, ms": f"{row['median_ms']:.1f}",
            "95 %, ms": f"{row['p95_ms']:.1f}",
            "in frames": f"{row['frames']} of {motions}",
        }
        for name, row in [*stages.items(), ("frame", whole)]
    ]
    return table(rows).splitlines()


def _platform_text(content: Content) -> list[str]:
    """Describe what is installed, and which methods can run."""
    packages = [
        f"{name} {version}" for name, version in content["packages"].items()
    ]
    methods = content["methods"]
    ready = [name for name, problem in methods.items() if not problem]
    missing = {name: problem for name, problem in methods.items() if problem}
    extras = content["extras"]
    present = [name for name, lack in extras.items() if not lack]
    rows = [
        ("platform", content["platform"]),
        ("packages", ", ".join(packages)),
        ("kernels", content["kernels"]),
        ("cuda", ", ".join(content["cuda"]) or "none"),
        ("methods", ", ".join(ready)),
        *(("not ready", reason) for reason in reasons_of(missing)),
        ("extras", ", ".join(present) or "none"),
        *(("no extra", f"{name}: {lack}") for name, lack in extras.items() if lack),
    ]
    # doctor, which asked each method, has imported it
    from hybridvo.pipeline import DEFAULT_METHOD

    if DEFAULT_METHOD in ready:
        optional = "what is 'not ready', or 'no extra', is optional"
        works = "hybridvo run DIR" + (", hybridvo demo" if "lab" in present else "")
        rows.append(("works", f"{works}; {optional}"))
    return [f"{label:<{PLATFORM_WIDTH}}{text}" for label, text in rows]


def _topics_text(content: Content) -> list[str]:
    """List the topics of a bag, and what is taken for what."""
    rows = [
        {
            "topic": row["name"],
            "messages": str(row["messages"]),
            "type": row["type"],
            "encoding": row["encoding"],
            "taken for": row["taken_for"],
        }
        for row in content["topics"]
    ]
    lines = [table(rows)] if rows else ["no topics"]
    for camera in content["cameras"]:
        lines += [
            f"camera {camera['camera'] or '/'}: {camera['intrinsics']}",
            f"  colour {camera['colour']}, depth {camera['depth'] or 'none'}",
            f"  registered to colour: {camera['registered']}",
        ]
    if content["problem"]:
        lines.append(content["problem"])
    return [*lines, *content["warnings"]]


def _convert_text(content: Content) -> list[str]:
    """State what was written, and what the user should know about it."""
    folder = content["files"][0]
    lines = [f"{content['frames']} frames written to {folder}"]
    return lines + [f"warning: {text}" for text in content["warnings"]]


WRITERS: dict[str, Callable[[Content], list[str]]] = {
    "init": _init_text,
    "run": _run_text,
    "live": _live_text,
    "evaluate": _evaluate_text,
    "doctor": _doctor_text,
    "topics": _topics_text,
    "convert": _convert_text,
}
"""The commands whose results are described; others list their files."""
