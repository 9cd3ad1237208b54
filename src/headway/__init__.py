"""Headway: control that keeps making headway when the physics changes.

    run = headway.train("pendulum", preset="quick", seed=0)
    controller = headway.load(run.path)
    action = controller.act(obs)

Public names stand in `__init__.pyi` and are loaded when first used, so `import headway` is quick
and brings in no simulator.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
