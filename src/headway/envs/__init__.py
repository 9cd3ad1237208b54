"""Environments whose physics can be set.

Names stand in `__init__.pyi` and are loaded when first used: a controller takes a Task from here
and needs no simulator. `make` and `make_vec` also tell Gymnasium the ids `headway/Hopper-v0` etc.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
