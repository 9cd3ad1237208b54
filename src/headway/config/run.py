"""All settings of a run."""

import dataclasses
from collections.abc import Mapping

from headway.config.fitting import FittingConfig
from headway.config.model import ModelConfig
from headway.config.planner import PlannerConfig
from headway.config.protocol import CollectionConfig, EvaluationConfig
from headway.errors import shown
from headway.problems import Problems
from headway.sim_params import SimParamSets


@dataclasses.dataclass(frozen=True)
class Config:
    """Everything that decides a run's numbers."""

    env: str
    """Short name of the environment."""
    method: str = "tmcl"
    """Name of the method the settings started from."""
    preset: str = "paper"
    """Name of the preset the settings started from."""
    seed: int = 0
    """Seeds environments, physics, initial weights, batches and planner."""
    env_options: Mapping[str, bool] = dataclasses.field(default_factory=dict)
    """Switches of the environment that differ from its defaults."""
    sim_params: SimParamSets | None = None
    """Training and unseen simulator parameters; None takes the environment's own."""
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    """The dynamics model."""
    fitting: FittingConfig = dataclasses.field(default_factory=FittingConfig)
    """Fitting the model."""
    planner: PlannerConfig = dataclasses.field(default_factory=PlannerConfig)
    """Planning with the model."""
    collection: CollectionConfig = dataclasses.field(default_factory=CollectionConfig)
    """Collecting data."""
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    """Testing."""

    def __post_init__(self):
        problems = Problems(self)
        problems.between(0, 2**31 - 1, "seed")
        problems.require(
            self.planner.num_particles % self.model.num_members == 0,
            f"planner.num_particles is {self.planner.num_particles}, allowed: a multiple of"
            f" model.num_members ({self.model.num_members})",
        )
        problems.require(
            not self.model.relation_head or self.fitting.precision == "float32",
            f"fitting.precision is {shown(self.fitting.precision)}, allowed: float32 with a"
            " relation head, whose losses are most of a fit and always float32",
        )
        problems.require(
            self.model.kind != "simulator" or self.planner.num_particles == 1,
            f"planner.num_particles is {self.planner.num_particles}, allowed: 1, because the"
            " simulator has no noise",
        )
        problems.require(
            self.model.kind != "simulator" or self.planner.reward == "task",
            f"planner.reward is {shown(self.planner.reward)}, allowed: task, which the simulator"
            " pays",
        )
        problems.require(
            self.model.kind != "simulator" or not self.collection.env_processes,
            "collection.env_processes is True, allowed: False with plans on the simulator itself",
        )
        problems.report()
