"""`python -m rbpf`."""

import sys

from rbpf.cli import main

sys.exit(main())
