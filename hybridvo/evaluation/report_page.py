"""The report of a comparison: ``report.html`` and ``report.md`` from the other files of its folder.

:func:`write_report` needs nothing but the folder, so a report can be made again at any time, and
is all that ``tools/compare_methods.py`` calls. It reads

``results.json``
    as :mod:`hybridvo.evaluation.breakdown` and :mod:`hybridvo.evaluation.protocols` describe it:
    ``command``, ``versions``, ``machine``, ``missing``, ``rows``; where they are there also
    ``breakdown``, ``worst_pairs``, ``protocol``, ``totals`` (rows over all sequences, one per
    method and flow source, ``sequence`` being "all"), ``weights`` (method -> what is known of its
    weights), and ``trajectories``: a list of ``sequence``, ``method`` and ``flow_source`` (both
    null for the truth) and ``path``, a TUM file relative to the folder;
``pairs.csv``
    a row per pair and method: errors over time and times;
``figures/*.json``
    what ``tools/visualize.py --into FOLDER`` left: ``title``, ``caption``, ``numbers``, and
    ``picture``, a PNG, JPEG or SVG file relative to the folder.

Everything but ``results.json`` may be absent; what is absent is left out of the page.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["write_report"]


def write_report(folder: str | os.PathLike[str]) -> list[Path]:
    """Write ``report.html`` (one self-contained file) and ``report.md`` into a results folder.

    Args:
        folder: output of ``tools/compare_methods.py``.

    Returns:
        The files written.

    Raises:
        InputError: no ``results.json``, or one that is not as described above.
        OutputError: a file cannot be written.
    """
    raise NotImplementedError
