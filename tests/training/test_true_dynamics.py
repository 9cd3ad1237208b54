"""The simulator as a model: it imagines what the environments do, and nothing else."""

import dataclasses
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import headway
from headway.envs.built_in import ClassicVectorEnv
from headway.envs.physics import try_out
from headway.errors import ConfigError
from headway.lab.figures import save_run_figures
from headway.models.simulator import ClassicSimulator, EnvSimulator
from headway.planning.rollouts import candidate_returns
from headway.task import env_action, env_spec
from headway.training.environments import Environments
from headway.training.methods import make_config
from headway.training.trainers import make_trainer

EXAMPLES = Path(__file__).parents[2] / "examples"
CLASSIC = ["pendulum", "cartpole-swingup"]
ROBOTS = ["hopper", "slim-humanoid", "half-cheetah", "crippled-ant"]
SHORT = {"collection.episode_length": 6}
SMALL = {"planner.num_candidates": 6, "planner.optimizer.num_elites": 2, "planner.horizon": 5}


def every_physics(env):
    sets = env_spec(env).sim_params
    return [values for group in sets.group_names for values in sets.group(group)]


def begin(env, physics, *, steps=7):
    """Environments, one per physics, some random steps into an episode."""
    count = {"collection.num_episodes": len(physics), "evaluation.num_episodes": len(physics)}
    settings = {**count, **SMALL}
    config = make_config(env, method="true-dynamics", preset="smoke", settings=settings)
    environments = Environments.make(config)
    config = dataclasses.replace(config, spaces=environments.task.spaces)
    columns = {name: np.array([values[name] for values in physics]) for name in physics[0]}
    environments.vector.reset(seed=[*range(len(physics))], options={"sim_params": columns})
    rng = np.random.default_rng(3)
    for _ in range(steps):
        environments.vector.step(random_actions(environments, rng))
    return config, environments


def random_actions(environments, rng):
    shape = (environments.vector.num_envs, environments.task.action_size)
    return env_action(environments.task, rng.uniform(-1, 1, shape).astype(np.float32))


def play(environments, sequence):
    """Returns that the environments themselves pay for [env, horizon, action], in [-1, 1]."""
    total = np.zeros(environments.vector.num_envs)
    for step in range(sequence.shape[1]):
        actions = env_action(environments.task, sequence[:, step])
        total += environments.vector.step(actions)[1]
    return total


def test_as_many_environments_as_tests_fill_at_most():
    settings = {"collection.num_episodes": 50, "evaluation.num_episodes": 2}
    for method, count in {"true-dynamics": 6, "random": 6, "tmcl": 50}.items():
        config = make_config("pendulum", method=method, preset="smoke", settings=settings)
        assert Environments.make(config).vector.num_envs == count


@pytest.mark.parametrize("env", CLASSIC)
def test_compiled_equations_step_as_the_environment_under_every_physics(env):
    physics = [{**row, "gain": gain} for gain in (1.0, -0.7) for row in every_physics(env)]
    _, environments = begin(env, physics)
    vector = environments.vector
    assert isinstance(vector, ClassicVectorEnv)
    rng = np.random.default_rng(0)
    sim_params = {k: jnp.asarray(v, jnp.float32) for k, v in vector.sim_params.items()}
    step = jax.jit(lambda s, a: vector.world.next_state(s, a, sim_params, jnp))
    for _ in range(12):
        before = vector.states.copy()
        actions = random_actions(environments, rng)
        obs = vector.step(actions)[0]
        found = step(jnp.asarray(before, jnp.float32), jnp.asarray(actions))
        # Numbers of up to a few hundred in single precision, amplified by light masses.
        np.testing.assert_allclose(found, vector.states, rtol=3e-6, atol=3e-5)
        np.testing.assert_allclose(vector.world.observe(found, jnp), obs, rtol=3e-6, atol=3e-5)


def agent_of(config, environments):
    return make_trainer(config, environments).agent(())


def simulator_of(config, environments):
    """The model that plans in some environments, and what it believes of them."""
    model = agent_of(config, environments).model
    assert isinstance(model, ClassicSimulator | EnvSimulator)
    return model, model.init_belief(environments.vector.num_envs)


@pytest.mark.parametrize("env", CLASSIC)
def test_imagined_returns_of_the_equations_are_what_the_environment_pays(env):
    config, environments = begin(env, every_physics(env))
    model, belief = simulator_of(config, environments)
    sequences = np.random.default_rng(1).uniform(-1, 1, (environments.vector.num_envs, 3, 9, 1))
    candidates = jnp.asarray(sequences, jnp.float32)
    obs = model.vector.world.observe(jnp.asarray(belief.state), jnp)
    args = model.dynamics(belief), environments.task, obs, candidates
    found = candidate_returns(*args, planner=config.planner, key=jax.random.key(0))
    paid = play(environments, np.asarray(candidates[:, 1]))
    np.testing.assert_allclose(found[:, 1], paid, rtol=1e-4)
    assert np.abs(found[:, 0] - paid).min() > 1e-4


def test_a_step_plans_from_where_the_environments_are_now():
    config, environments = begin("pendulum", every_physics("pendulum")[:2])
    agent = agent_of(config, environments)
    state = agent.init(2, key=jax.random.key(0))
    for _ in range(2):
        obs = environments.vector.step(np.ones((2, 1), np.float32))[0]
        state, _ = agent.act(state, obs)
        np.testing.assert_allclose(state.belief.state, environments.vector.states, rtol=1e-6)
        np.testing.assert_allclose(
            state.belief.sim_params["length"], environments.vector.sim_params["length"]
        )


@pytest.mark.parametrize("env", ROBOTS)
def test_imagined_returns_of_robots_are_what_the_environment_pays_to_the_bit(env):
    config, environments = begin(env, every_physics(env))
    simulator, _ = simulator_of(config, environments)
    shape = (environments.vector.num_envs, 3, 6, environments.task.action_size)
    candidates = np.random.default_rng(1).uniform(-1, 1, shape).astype(np.float32)
    found = np.asarray(simulator.returns(candidates))
    again = np.asarray(simulator.returns(candidates))
    paid = play(environments, candidates[:, 1])
    np.testing.assert_array_equal(found, again)
    np.testing.assert_allclose(found[:, 1], paid, rtol=1e-6)
    assert np.abs(found[:, 0] - paid).min() > 1e-4


@pytest.mark.parametrize("module", ["cartpole", "drone", "walker"])
def test_imagined_returns_of_own_environments_are_what_they_pay(module, monkeypatch):
    """Numbers in Python, copied, and MuJoCo's data, put back; discrete and continuous actions."""
    monkeypatch.syspath_prepend(EXAMPLES)
    config, environments = begin(f"{module}:spec", [{}, {}], steps=4)
    simulator, _ = simulator_of(config, environments)
    shape = (2, 3, 6, environments.task.action_size)
    candidates = np.random.default_rng(1).uniform(-1, 1, shape).astype(np.float32)
    found, again = simulator.returns(candidates), simulator.returns(candidates)
    paid = play(environments, candidates[:, 1])
    np.testing.assert_array_equal(found, again)
    np.testing.assert_allclose(found[:, 1], paid, rtol=1e-6)


def test_what_was_tried_does_not_bring_the_time_limit_of_mujoco_nearer():
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=20)
    env.reset(seed=0)
    assert try_out(env, np.zeros((3, 8, 1), np.float32)) == [8.0, 8.0, 8.0]
    ends = [any(env.step(np.zeros(1, np.float32))[2:4]) for _ in range(20)]
    assert ends == [False] * 19 + [True]


def test_an_environment_that_cannot_be_copied_is_refused():
    class Uncopied(gymnasium.Wrapper):
        def __deepcopy__(self, memo):
            raise TypeError("it holds a socket")

    with pytest.raises(ConfigError, match=r"cannot be copied .*holds a socket.*, allowed:"):
        try_out(Uncopied(gymnasium.make("CartPole-v1")), [[0]])


def test_a_robot_that_mujoco_gives_up_on_ranks_last():
    config, environments = begin("half-cheetah", every_physics("half-cheetah")[:1])
    environments.vector.datas[0].qpos[4] = 1e12  # beyond what MuJoCo accepts
    simulator, _ = simulator_of(config, environments)
    candidates = np.zeros((1, 2, 4, environments.task.action_size), np.float32)
    assert not np.isfinite(simulator.returns(candidates)).any()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run on the simulator, which needs no fit."""
    path = tmp_path_factory.mktemp("true-dynamics") / "run"
    return headway.train(
        "pendulum", method="true-dynamics", preset="smoke", run_dir=path, settings=SMALL | SHORT
    )


def test_a_run_on_the_simulator_is_a_test_and_can_be_tested_again(run):
    groups = env_spec("pendulum").sim_params.group_names
    assert [row.group for row in run.evaluation] == [g for g in groups for _ in range(2)]
    assert [metrics["timesteps"] for metrics in run.metrics] == [0]
    assert [path.name for path in save_run_figures(run.path)] == ["evaluation.png"]
    again = headway.evaluate(run.path, groups=["train"], num_episodes=1)
    assert len(again) == 1
    assert (again.cost.evaluations_per_step, again.cost.flop_per_step) == (2 * 6, 0)


def test_a_run_on_the_simulator_has_no_controller_to_load(run):
    with pytest.raises(ConfigError, match=r"no controller of its own, allowed:"):
        headway.load(run.path)


def test_random_actions_are_uniform_within_bounds_and_the_simulator_beats_them(tmp_path):
    search = {
        "planner.horizon": 15,
        "planner.num_candidates": 60,
        "planner.optimizer.num_elites": 10,
    }
    longer = {"collection.episode_length": 100, "collection.num_episodes": 8}
    returns = {}
    for method, settings in (("random", longer), ("true-dynamics", search | longer)):
        run = headway.train(
            "pendulum", method=method, preset="smoke", run_dir=tmp_path / method, settings=settings
        )
        returns[method] = np.mean([row.episode_return for row in run.evaluation])
    assert returns["true-dynamics"] > 0.6 * returns["random"]  # both are negative
    controller = headway.load(tmp_path / "random")
    actions = np.array([controller.act(np.zeros(3))[0] for _ in range(400)])
    assert np.abs(actions).max() <= 2.0
    assert abs(actions.mean()) < 0.2
    np.testing.assert_allclose(actions.std(), 2 / np.sqrt(3), rtol=0.1)
