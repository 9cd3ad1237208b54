"""Seconds that mbrl-lib takes for plans of the paper's HalfCheetah size. Runs in its own venv.

The same work as Headway's: ensemble of 5 networks of 4 x 200 swish units with means and
variances, normalised inputs, HalfCheetah's features and reward, particles that stay with one
member, CEM that returns the mean of its elites. mbrl-lib plans for one environment at a time.
"""

import argparse
import json
import time

import gymnasium
import numpy as np
import omegaconf
import torch
from mbrl.models import GaussianMLP, ModelEnv, OneDTransitionRewardModel
from mbrl.planning import TrajectoryOptimizer

OBS_SIZE, ACTION_SIZE = 18, 6
HORIZON, PARTICLES = 30, 20
CEM = {
    "_target_": "mbrl.planning.CEMOptimizer",
    "num_iterations": 5,
    "elite_ratio": 0.25,
    "population_size": 200,
    "alpha": 0.1,
    "device": "cpu",
    "lower_bound": None,
    "upper_bound": None,
    "return_mean_elites": True,
}


def features(obs: torch.Tensor) -> torch.Tensor:
    """HalfCheetah's features: no velocity average, the pitch as sine and cosine."""
    obs = torch.as_tensor(obs)
    pitch = obs[:, 2:3]
    return torch.cat([obs[:, 1:2], torch.sin(pitch), torch.cos(pitch), obs[:, 3:]], dim=1)


def reward(action: torch.Tensor, next_obs: torch.Tensor) -> torch.Tensor:
    """HalfCheetah's reward."""
    return (next_obs[:, 0] - 0.1 * action.clamp(-1, 1).square().sum(1))[:, None]


def never(action: torch.Tensor, next_obs: torch.Tensor) -> torch.Tensor:
    """No episode ends early."""
    del action
    return torch.zeros(len(next_obs), 1, dtype=torch.bool)


class Sizes(gymnasium.Env):
    """Holds the spaces that `ModelEnv` reads."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS_SIZE,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,))


def make_model_env() -> ModelEnv:
    """An untrained ensemble as an environment."""
    network = GaussianMLP(
        in_size=OBS_SIZE + ACTION_SIZE,
        out_size=OBS_SIZE,
        device="cpu",
        num_layers=4,
        ensemble_size=5,
        hid_size=200,
        propagation_method="fixed_model",
        learn_logvar_bounds=True,
        activation_fn_cfg={"_target_": "torch.nn.SiLU"},
    )
    model = OneDTransitionRewardModel(
        network,
        target_is_delta=True,
        normalize=True,
        learned_rewards=False,
        obs_process_fn=features,
        no_delta_list=[0],
    )
    return ModelEnv(Sizes(), model, never, reward)


def main() -> None:
    """Print the seconds of each plan as a JSON list, after one that is not counted."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--num-envs", type=int, default=1)
    parser.add_argument("--plans", type=int, default=3)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    env = make_model_env()
    low, high = -np.ones(ACTION_SIZE), np.ones(ACTION_SIZE)
    planners = [
        TrajectoryOptimizer(omegaconf.OmegaConf.create(CEM), low, high, HORIZON)
        for _ in range(arguments.num_envs)
    ]
    obs = 0.1 * np.random.default_rng(0).standard_normal((arguments.num_envs, OBS_SIZE))

    def plan() -> float:
        start = time.perf_counter()
        for planner, one in zip(planners, obs, strict=True):
            planner.optimize(
                lambda actions, one=one: env.evaluate_action_sequences(actions, one, PARTICLES)
            )
        return time.perf_counter() - start

    print(json.dumps([plan() for _ in range(arguments.plans + 1)][1:]))


if __name__ == "__main__":
    main()
