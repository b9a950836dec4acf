"""`python -m rbpf`."""

import sys

from rbpf.cli import main

if __name__ == "__main__":
    sys.exit(main())
