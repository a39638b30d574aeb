"""Compare methods on sequences and write a report: the same
as ``hybridvo compare``.
"""

import sys

from hybridvo.run.cli import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
