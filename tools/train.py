"""Train a network: the same as ``hybridvo train``, run from
a checkout of the source.
"""

import sys

from hybridvo.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
