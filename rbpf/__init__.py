"""Rao-Blackwellised particle filters: bring a motion model and an observation model, get FastSLAM-2.0 inference.

The public names are in `__init__.pyi`. They are imported on first use, so that `import rbpf` is fast.
"""

import lazy_loader

__version__ = "0.2.0.dev0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
