"""Environments whose physics can be set. Importing this registers them with Gymnasium."""

from headway.envs.classic import CartPoleSwingUpEnv, PendulumEnv
from headway.envs.locomotion import CrippledAntEnv, HalfCheetahEnv, HopperEnv, SlimHumanoidEnv
from headway.envs.making import make, make_vec, register_all
from headway.envs.processes.vector import ProcessVectorEnv
from headway.envs.separate import SequentialVectorEnv
from headway.envs.vector import HeadwayVectorEnv
from headway.envs.vector_worlds import ClassicVectorEnv, RolloutVectorEnv

__all__ = [
    "CartPoleSwingUpEnv",
    "ClassicVectorEnv",
    "CrippledAntEnv",
    "HalfCheetahEnv",
    "HeadwayVectorEnv",
    "HopperEnv",
    "PendulumEnv",
    "ProcessVectorEnv",
    "RolloutVectorEnv",
    "SequentialVectorEnv",
    "SlimHumanoidEnv",
    "make",
    "make_vec",
]

register_all()
