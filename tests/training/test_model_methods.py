"""What methods that differ in the model are told, and what they learn of it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import headway
import toys
from headway.data import Trajectory
from headway.models.statistics import network_input
from headway.training.methods import make_config, told_sim_params
from headway.training.trainers import make_trainer


def test_only_oracle_params_is_told_the_physics():
    told = {name: told_sim_params(make_config("pendulum", method=name)) for name in headway.METHODS}
    assert told.pop("oracle-params") == ("length", "mass")
    assert set(told.values()) == {()}
    own = headway.SimParamSets({"mass": (1.0,), "length": (0.5, 1.0)})
    config = make_config("pendulum", method="oracle-params", settings={"sim_params": own})
    assert told_sim_params(config) == ("mass", "length")


def masses(num_episodes, steps=30, seed=0):
    """A force moves a mass; episodes have one of two masses. State: position and velocity."""
    rng = np.random.default_rng(seed)
    trajectories = []
    for episode in range(num_episodes):
        mass = (0.5, 2.0)[episode % 2]
        force = rng.uniform(-1, 1, (steps, 1)).astype(np.float32)
        speed = np.concatenate([[0.0], np.cumsum(0.5 * force[:, 0] / mass)])
        obs = np.stack([np.cos(speed), np.sin(speed), speed], 1).astype(np.float32)
        trajectories.append(Trajectory(obs, force, np.zeros(steps), {"mass": mass, "length": 1.0}))
    return trajectories


FITTED = {
    "model.num_members": 1,
    "model.deterministic": True,
    "model.hidden_sizes": (32, 32),
    "planner.num_particles": 1,
    "fitting.learning_rate": 5e-3,
    "fitting.batch_size": 64,
    "fitting.epochs": 60,
    "collection.num_episodes": 30,
    "collection.episode_length": 30,
    "model.history_length": 5,
}


def fitted_error(method):
    """Squared error of the speed's change on new episodes, in its own variance."""
    config = make_config("pendulum", method=method, preset="smoke", settings=FITTED)
    trainer = make_trainer(config)
    *_, (state, _) = trainer.fit(trainer.begin(), masses(40), 0, jax.random.key(0))
    model, statistics = state.fit.model, state.statistics
    episodes = trainer.pad(masses(4, seed=1))
    row = jnp.repeat(jnp.arange(4), 25)[None]
    step = jnp.tile(jnp.arange(5, 30), 4)[None]
    past = episodes.history(row, step, 5)
    context = model.context(past, statistics, episodes.sim_params[row])
    obs, next_obs = episodes.obs[row, step], episodes.obs[row, step + 1]
    x = network_input(trainer.task, statistics, obs, episodes.action[row, step])
    mean = toys.predict(model.forward_net, x, context).mean[0, 0, :, 2]
    delta = np.asarray(next_obs - obs)[0, :, 2]
    got = np.asarray(mean) * statistics.delta.std[2] + statistics.delta.mean[2]
    return float(np.square(got - delta).mean() / delta.var())


@pytest.mark.slow
def test_history_and_true_parameters_help_where_the_mass_is_hidden():
    errors = {method: fitted_error(method) for method in ("vanilla", "stacked", "oracle-params")}
    assert errors["vanilla"] > 0.15
    assert errors["stacked"] < 0.5 * errors["vanilla"]
    assert errors["oracle-params"] < 0.1 * errors["vanilla"]
