"""The folder of a ROS 2 bag: which files hold its messages, and how they are packed."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any, NamedTuple

from hybridvo.core.errors import FormatError
from hybridvo.core.files import MAX_YAML_LENGTH, parse_yaml, read_head, read_text

STORAGE_FILES = (".mcap", ".db3")
"""Endings of the files in the folder of a ROS 2 bag."""
PACKED = ".zstd"
"""What follows the ending of a file that is packed as a whole."""
METADATA = "metadata.yaml"
INFORMATION = "rosbag2_bagfile_information"
"""The key under which it states what is in the bag."""
MAX_METADATA_NODES = 20_000
"""Keys and values: some hundred topics, each with the quality of service of its publishers."""


class Contents(NamedTuple):
    """What is in the folder of a bag."""

    files: list[Path]  # which hold messages, in their order
    are_messages_packed: bool  # each by itself, by zstd
    notes: list[str]  # sentences about what is missing


def is_bag_folder(folder: Path) -> bool:
    """Return whether a folder is a ROS 2 bag: by its files, or by what states its contents."""
    return bool(storage_files(folder)) or _states_contents(folder / METADATA)


def storage_files(folder: Path) -> list[Path]:
    """Return the files in a folder that hold messages; a pipe or a device is none."""
    return [
        path for path in sorted(folder.iterdir()) if _is_storage(path.name, path)
    ]


def contents(folder: Path) -> Contents:
    """Find out what is in the folder of a bag.

    Args:
        folder: The bag.

    Returns:
        The files that its metadata name; all that look like some where it states none.

    Raises:
        FormatError: There is no file with messages.
    """
    notes = list[str]()
    files = storage_files(folder)
    are_messages_packed = False
    if (folder / METADATA).is_file():
        try:
            stated = _information(folder / METADATA)
            are_messages_packed = _are_messages_packed(stated)
            files = _listed(stated, folder, notes) or files
        except FormatError as error:
            notes.append(f"{error} All files of the folder are used.")
    else:
        notes.append(f"{folder}: there is no {METADATA}: was recording cut off?")
    if not files:
        raise FormatError(
            f"{folder}: damaged: no file of messages. {' '.join(notes)}"
        )
    return Contents(files, are_messages_packed, notes)


def _is_storage(name: str, path: Path) -> bool:
    return (
        name.lower().removesuffix(PACKED).endswith(STORAGE_FILES) and path.is_file()
    )


def _states_contents(path: Path) -> bool:
    """Whether a file states the contents of a bag near its beginning."""
    if not path.is_file():
        return False
    return INFORMATION.encode() in read_head(path, MAX_YAML_LENGTH)


def _information(path: Path) -> dict[str, Any]:
    """What the file of metadata states."""
    text = read_text(path, MAX_YAML_LENGTH)
    content = parse_yaml(text, str(path), MAX_METADATA_NODES)
    stated = content.get(INFORMATION) if isinstance(content, dict) else None
    if not isinstance(stated, dict):
        raise FormatError(f"{path}: expected '{INFORMATION}:', which is not there.")
    return stated


def _are_messages_packed(stated: dict[str, Any]) -> bool:
    return str(stated.get("compression_mode", ""))[:20].lower() == "message"


def _listed(stated: dict[str, Any], folder: Path, notes: list[str]) -> list[Path]:
    """The files that metadata list, as far as they are there."""
    names = stated.get("relative_file_paths")
    found = list[Path]()
    if not isinstance(names, list):
        return found
    for given in names:
        # written by a version that stated them from elsewhere
        name = PurePath(given).name if isinstance(given, str) else ""
        path = folder / name
        if _is_storage(name, path):
            found.append(path)
        else:
            notes.append(
                f"{folder}: '{str(given)[:80]}', which it lists, is not there."
            )
    return found
