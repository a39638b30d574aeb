"""Train the networks: the same as ``hybridvo train``, as a file."""

from __future__ import annotations

import sys

from hybridvo import cli


def main(words: list[str] | None = None) -> int:
    return cli.main(["train", *(sys.argv[1:] if words is None else words)])


if __name__ == "__main__":
    raise SystemExit(main())
