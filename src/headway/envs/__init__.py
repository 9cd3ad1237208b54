"""Gymnasium environments whose physics can be set, one or many; importing this tells their ids.

Names stand in `__init__.pyi` and are loaded when first used: a process of one's own environment
needs neither JAX nor a simulator of ours.
"""

import gymnasium
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

for _name, _id, _steps in (
    ("pendulum", "headway/Pendulum-v0", 200),
    ("cartpole-swingup", "headway/CartPoleSwingUp-v0", 500),
    ("hopper", "headway/Hopper-v0", 500),
    ("slim-humanoid", "headway/SlimHumanoid-v0", 1000),
    ("half-cheetah", "headway/HalfCheetah-v0", 1000),
    ("crippled-ant", "headway/CrippledAnt-v0", 1000),
):
    gymnasium.register(
        _id,
        entry_point="headway.envs.built_in:HeadwayEnv",
        max_episode_steps=_steps,
        disable_env_checker=True,
        kwargs={"name": _name},
    )
