"""Rao-Blackwellised particle filters: FastSLAM-2.0 inference for any motion and observation model.

The public names are in `__init__.pyi`. They are imported on first use to keep `import rbpf` fast.
"""

import lazy_loader

__version__ = "0.2.0.dev0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
