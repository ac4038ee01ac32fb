"""Segments-on-floor monocular SLAM: JAX-vectorised, differentiable; Zhang and Suh's paper and on.

The public names stand in `__init__.pyi`, in reading order. Each is loaded when it is first used, so
that `import sofjax` costs nothing.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
