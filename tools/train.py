"""Train the networks: the same as ``hybridvo train``, as a file for torchrun."""

from __future__ import annotations

from hybridvo.commands.train import main

if __name__ == "__main__":
    raise SystemExit(main())
