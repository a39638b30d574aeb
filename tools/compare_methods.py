"""``hybridvo compare`` under its old path: methods side by side on sequences, and a report."""

import sys

from hybridvo.cli import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
