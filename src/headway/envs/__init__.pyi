# Public names and their modules, the only list of them; `__init__.py` loads each at its first use.

from .built_in import ClassicVectorEnv as ClassicVectorEnv
from .built_in import HeadwayEnv as HeadwayEnv
from .built_in import RobotVectorEnv as RobotVectorEnv
from .built_in import make as make
from .built_in import make_vec as make_vec
from .physics import MujocoPhysics as MujocoPhysics
from .vector import HeadwayVectorEnv as HeadwayVectorEnv
from .vector import ProcessVectorEnv as ProcessVectorEnv
from .vector import SequentialVectorEnv as SequentialVectorEnv

__all__: list[str]
