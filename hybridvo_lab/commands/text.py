"""What the laboratory's commands print for people."""

from __future__ import annotations

from typing import Any

from hybridvo.run.commands.terminal import table
from hybridvo.run.commands.text import Content, reasons_of
from hybridvo_lab.evaluation.report import protocol_rows, summary_rows


def compare_text(content: Content) -> list[str]:
    """Show the short table of a comparison, and where its results lie."""
    return [
        table(summary_rows(content["totals"])),
        "",
        "wrong: failed, or an EPE above the limit: 1 px, "
        "or what the ground truth itself errs by if that is more",
        *_without_errors(content["totals"]),
        *_not_run(content["missing"]),
        *_protocol_means(content["protocol"]),
        "",
        *content["files"],
    ]


def _without_errors(totals: list[Content]) -> list[str]:
    """State why the table has no errors, and what is known without them."""
    if any(total["pairs_scored"] for total in totals):
        return []
    failed = [
        f"{total['method']} {total['failed']} of {total['pairs']}"
        for total in totals
    ]
    return [
        "no errors: no pair has ground truth, or none was estimated; "
        f"motions that failed: {', '.join(failed)}"
    ]


def _protocol_means(protocol: Content | None) -> list[str]:
    """Show the figures of a protocol beside the published ones, and why some are missing."""
    if protocol is None:
        return []
    lines = ["", f"protocol {protocol['name']}: {protocol['note']}"]
    rows = protocol_rows(protocol)
    for row in rows:
        # too wide for a terminal
        del row["inputs"]
    if rows:
        lines.append(table(rows))
        lines.append("what each method was given: report.tex and report.md")
    for total in protocol["totals"]:
        reasons = dict.fromkeys(total["reasons"].values())
        lines += [f"{total['method']}: {reason}" for reason in reasons]
    return lines


def _not_run(missing: Content) -> list[str]:
    """List the methods that did not run, and why."""
    return [f"not run: {reason}" for reason in reasons_of(missing)]


def demo_text(content: Content) -> list[str]:
    """Show the table of the demo, and what to try next."""
    scene = content["scene"]
    moving = 100 * content["moving_fraction"]
    return [
        f"{scene['frames']} rendered frames of {scene['width']}x{scene['height']}, "
        f"{moving:.0f} % of the pixels move by themselves; "
        "flow: OpenCV DIS on the images; depth: the renderer's (true).",
        "ATE after aligning the first pose, the other errors are means a pair.",
        "",
        table([_demo_row(row) for row in content["rows"]]),
        "",
        *content["doubts"],
        f"report: {content['report']}",
        "next:  hybridvo run DIR       your own sequence (hybridvo init DIR writes camera.yaml)",
        "       hybridvo doctor DIR    what is wrong with it",
    ]


def _demo_row(row: Content) -> dict[str, str]:
    """Return a row of the demo's table as texts."""

    def as_text(value: Any) -> str:
        if value is None:
            return "-"
        return value if isinstance(value, str) else f"{value:.4g}"

    return {name: as_text(value) for name, value in row.items()}
