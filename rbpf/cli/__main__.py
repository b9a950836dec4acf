"""`python -m rbpf.cli`."""

import sys

from rbpf.cli import main

sys.exit(main())
