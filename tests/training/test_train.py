"""The whole loop, at its smallest size: repeatability, tests of a run, divergence, odd data."""

import jax
import numpy as np
import pytest

import headway
import runs
from headway.data import Trajectory
from headway.errors import ConfigError, DivergenceError, UnknownNameError
from headway.models.fitting import EpochStats
from headway.training import train
from headway.training.environments import Environments
from headway.training.run import RunDir
from headway.training.trainers import make_trainer


def test_groups_are_tested_when_the_settings_say(reference):
    rows = RunDir(reference).evaluation()
    assert [(i, sum(row.iteration == i for row in rows)) for i in range(3)] == [
        (0, 2 * 2),  # low and high
        (1, 2 * 2),
        (2, 3 * 2),  # training physics at the end
    ]


def test_a_seed_makes_a_run_and_a_finished_run_is_left_alone(reference, tmp_path):
    wanted = runs.result(reference)
    train.train_run(runs.tiny_config(), tmp_path / "again")
    train.train_run(runs.tiny_config(), tmp_path / "again")
    assert runs.result(tmp_path / "again") == wanted
    train.train_run(runs.tiny_config(seed=7), tmp_path / "other")
    assert runs.result(tmp_path / "other")[0] != wanted[0]


def test_environments_are_closed_where_nothing_comes_of_a_run(root, monkeypatch):
    """They may be processes, which would stay for as long as somebody keeps the error."""
    made, closed = [], []
    make, close = Environments.make, Environments.close
    monkeypatch.setattr(Environments, "make", lambda config: made.append(make(config)) or made[-1])
    monkeypatch.setattr(Environments, "close", lambda one: closed.append(one) or close(one))
    with pytest.raises(headway.RunError):
        train.train_run(runs.tiny_config(seed=1), root)
    with pytest.raises(UnknownNameError):
        headway.evaluate(root, groups=["highest"])
    train.train_run(runs.tiny_config(), root)
    assert len(made) == len(closed) == 3


def rows_of(rows, groups, iteration):
    found = [row.to_csv() for row in rows if row.group in groups and row.iteration == iteration]
    return sorted(found, key=str)


@pytest.mark.parametrize(
    ("random", "groups", "iteration"),
    [(False, None, None), (False, ["high", "low"], 1), (True, ["low"], None)],
)
def test_a_runs_own_tests_give_their_numbers_again(random, groups, iteration, reference, tmp_path):
    run = RunDir(reference)
    if random:
        own = runs.random_config(**{"evaluation.num_episodes": 3})  # groups share batches
        run = train.train_run(own, tmp_path / "run")
    heard, number = runs.Listening(), run.kept_iteration(iteration)
    found = headway.evaluate(run.path, groups=groups, iteration=iteration, progress=heard)
    tested = groups or ["train", "low", "high"]
    assert rows_of(found, tested, number) == rows_of(run.evaluation(), tested, number)
    assert len(found) == len(tested) * run.config().evaluation.num_episodes
    assert not heard.said


def test_new_draws_are_said_and_physics_need_no_group(reference):
    heard = runs.Listening()
    asked = {"groups": ["low"], "progress": heard}
    found = headway.evaluate(reference, sim_params={"length": 2.0}, **asked)
    assert rows_of(found, ["low"], 2) == rows_of(RunDir(reference).evaluation(), ["low"], 2)
    custom = [(row.sim_params["length"], row.group) for row in found[2:]]
    assert custom == [(2.0, "custom")] * 2
    headway.evaluate(reference, num_episodes=1, **asked)
    says = "New draws, not those of iteration 2's tests"
    reasons = ("custom was not tested", "evaluation.num_episodes: 2 -> 1")
    assert heard.said == [f"{says}: {reason}." for reason in reasons]
    (other,) = headway.evaluate(reference, sim_params={"gain": -1.0}, num_episodes=1)
    assert (other.group, other.sim_params["gain"]) == ("custom", -1.0)  # no set names it
    with pytest.raises(ConfigError, match=r"unknown sim_param .lenth.. Did you mean .length."):
        headway.evaluate(reference, sim_params={"lenth": 2.0})


def test_other_physics_beside_a_group_leave_its_episodes_alone(tmp_path):
    far = {"length": [3.0, 4.0], "mass": [5.0, 6.0]}  # in another order than in training
    sets = {"train": {"mass": [1.0], "length": [1.0, 2.0]}, "unseen": {"far": far}}
    own = {"sim_params": sets, "evaluation.num_episodes": 4}
    run = train.train_run(runs.random_config(**own), tmp_path / "run")
    found = headway.evaluate(run.path, groups=["far"], sim_params={"length": 9.0})
    assert rows_of(found, ["far"], 0) == rows_of(run.evaluation(), ["far"], 0)


def test_each_iteration_is_told_once_it_counts(tmp_path):
    told = []

    def fail(metrics):
        told.append(metrics)
        raise ZeroDivisionError

    config = runs.random_config(**{"collection.num_iterations": 2})
    with pytest.raises(ZeroDivisionError):
        train.train_run(config, tmp_path / "run", None, fail)
    assert told == train.train_run(config, tmp_path / "run", None, told.append).metrics()


@pytest.mark.parametrize(
    ("settings", "evaluations"),
    [
        ({}, 2 * 8),
        ({"planner.num_candidates": 6}, 2 * 6),
        ({"planner.optimizer.name": "random-shooting", "planner.num_iterations": 3}, 3 * 8),
    ],
)
def test_a_run_can_be_tested_with_another_planner(settings, evaluations, reference):
    before = runs.result(reference)
    found = headway.evaluate(reference, groups=["low"], num_episodes=3, settings=settings)
    assert [row.group for row in found] == ["low"] * 3
    assert found.cost.evaluations_per_step == evaluations
    rows_per_step = evaluations * 2 * 3  # particles, horizon
    assert found.cost.flop_per_step == rows_per_step * 2 * (4 * 8 + 8 * 8 + 8 * 6)
    assert 0 < found.cost.seconds_per_step < 60
    assert runs.result(reference) == before


def test_controller_stays_in_bounds_names_its_heads_and_forgets(reference):
    fresh, controller = headway.load(reference), headway.load(reference)
    assert controller.heads is None
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = controller.act(rng.uniform(-1, 1, 3))
        assert action.shape == (1,)
        assert np.abs(action) <= 2.0
    assert controller.heads.shape == (2,)
    assert set(controller.heads) <= {0, 1, 2}
    obs = np.array([1.0, 0.0, 0.5])
    controller.reset()
    fresh.reset()
    assert np.array_equal(fresh.act(obs), controller.act(obs))


def test_heads_of_a_run_share_every_segment(reference):
    totals: dict = {}
    for row in RunDir(reference).assignments():
        place = row["iteration"], row["member"], row["sim_params"]
        totals[place] = totals.get(place, 0.0) + row["share"]
    assert totals
    assert np.allclose(list(totals.values()), 1.0)


def stats(loss=1.0, skipped=0, updates=10):
    return EpochStats(*(np.asarray(x) for x in (loss, loss, skipped, updates)))


@pytest.mark.parametrize(
    ("epoch", "before", "problem"),
    [
        (stats(), [0.5, 2.0], None),
        (stats(skipped=5), [0.5, 2.0], None),
        (stats(skipped=6), [0.5, 2.0], "6 of 10 updates had no finite loss and gradient"),
        (stats(90.0), [0.5, 2.0], None),
        (stats(110.0), [0.5, 2.0], "the loss rose from 0.5 to 110"),
        (stats(float("nan")), [0.5, 2.0], "the loss rose from 0.5 to nan"),
        (stats(1e9), [], None),
    ],
)
def test_what_counts_as_divergence(epoch, before, problem):
    assert train.divergence(epoch, [stats(loss) for loss in before]) == problem


def diverge(monkeypatch, is_bad):
    """Let epochs diverge by the number of their look, from 1."""
    plain, looks = train.divergence, []

    def divergence(epoch, before):
        looks.append(1)
        return "the loss rose" if is_bad(len(looks)) else plain(epoch, before)

    monkeypatch.setattr(train, "divergence", divergence)


def test_a_diverging_epoch_is_made_again_with_a_smaller_step(reference, tmp_path, monkeypatch):
    diverge(monkeypatch, lambda look: look in (5, 6))  # second epoch of the second iteration
    heard = runs.Listening()
    run = train.train_run(runs.tiny_config(), tmp_path / "run", heard)
    assert [row["fitting"]["rollbacks"] for row in run.metrics()] == [0, 2, 0]
    says = "epoch 1 of iteration 1: the loss rose; made again with a smaller step."
    assert heard.said == [says, says]
    usual = RunDir(reference).metrics()
    assert run.metrics()[0]["fitting"] == usual[0]["fitting"]
    assert run.metrics()[1]["fitting"]["loss"] != usual[1]["fitting"]["loss"]


def test_what_diverges_for_good_stops_with_all_that_was_good(reference, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        diverge(patch, lambda look: look >= 5)
        with pytest.raises(DivergenceError, match="epoch 1 of iteration 1 diverged 4 times") as e:
            train.train_run(runs.tiny_config(), tmp_path / "run")
    assert "every member and head has a finite loss before" in str(e.value)
    train.train_run(runs.tiny_config(), tmp_path / "run")
    assert runs.result(tmp_path / "run") == runs.result(reference)


def fresh_model():
    trainer = make_trainer(runs.tiny_config(**{"fitting.weight_decay": 0.0}))
    return trainer, trainer.begin()


def with_bias(state, at, value):
    heads = state.fit.model.forward_net.mean_heads
    bias = heads.bias.at[at].set(value)
    return jax.tree.map(lambda x: bias if x is heads.bias else x, state)


def episodes(scale=1.0, steps=6, *, constant=False, dtype=np.float32):
    rng = np.random.default_rng(0)
    found = []
    for _ in range(3):
        obs = scale * rng.normal(size=(steps + 1, 3))
        if constant:
            obs[:, 2] = scale
        action = rng.uniform(-1, 1, (steps, 1)).astype(np.float32)
        found.append(Trajectory(obs.astype(dtype), action, np.zeros(steps), {"length": 1.0}))
    return found


def test_the_member_the_head_and_the_physics_of_a_divergence_are_named():
    trainer, state = fresh_model()
    losses = trainer.head_losses(with_bias(state, (1, 2), np.nan), episodes())
    found = train.first_non_finite(episodes(), losses)
    assert found == "member 1, head 2, at step 0 under sim_params {'length': 1.0}"


@pytest.mark.parametrize(
    "settings",
    [{"scale": 1e8}, {"scale": 1e-8}, {"constant": True}, {"steps": 1}, {"dtype": np.float64}],
    ids=str,
)
def test_odd_data_are_fitted_with_finite_numbers(settings):
    trainer, begun = fresh_model()
    for state, found in trainer.fit(begun, episodes(**settings), 5, jax.random.key(0)):
        assert int(found.skipped) == 0
        assert np.isfinite(found.loss)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.fit.model))


@pytest.mark.parametrize(("least", "passes"), [(0, 2), (6, 2), (31, 7)])
def test_few_data_are_gone_through_until_there_were_enough_updates(least, passes):
    sizes = {"min_updates": least, "batch_size": 8, "future_length": 2, "epochs": 2}
    settings = {f"fitting.{name}": size for name, size in sizes.items()}
    trainer = make_trainer(runs.tiny_config(**settings))
    assert trainer.num_epochs(episodes()) == passes  # 3 episodes of 6 and 5 pairs: 5 updates a pass
    found = [stats for _, stats in trainer.fit(trainer.begin(), episodes(), 0, jax.random.key(0))]
    assert len(found) == passes
    assert {int(stats.updates) for stats in found} == {5}


@pytest.mark.parametrize("method", ["tmcl", "pets", "grbal", "rebal", "ria"])
def test_updates_are_those_that_a_pass_makes(method):
    settings = {"fitting.batch_size": 16, "fitting.epochs": 1}
    settings |= {"model.adaptation_length": 2} if method == "grbal" else {}
    config = headway.make_config("pendulum", method=method, preset="smoke", settings=settings)
    trainer = make_trainer(config)
    data = [t for steps in (12, 1, 7) for t in episodes(steps=steps)]
    for _, stats in trainer.fit(trainer.begin(), data, 0, jax.random.key(0)):
        assert int(stats.updates) == trainer.num_updates(data)


def test_a_head_that_wins_nothing_is_harmless():
    """It keeps its weights but for weight decay, owns nothing, and the agent acts without it."""
    trainer, state = fresh_model()
    state = with_bias(state, (slice(None), 1), 1e3)
    before = state.fit.model.forward_net.mean_heads
    data = [t for steps in (6, 1, 3) for t in episodes(steps=steps)]
    for fitted, found in trainer.fit(state, data, 5, jax.random.key(0)):
        assert int(found.skipped) == 0
        state = fitted
    after = state.fit.model.forward_net.mean_heads
    np.testing.assert_array_equal(after.bias[:, 1], 1e3)
    np.testing.assert_array_equal(after.weight[:, 1], before.weight[:, 1])
    assert (after.weight[:, [0, 2]] != before.weight[:, [0, 2]]).any((1, 2, 3)).all()
    shares = trainer.head_shares(state, data)
    assert {row["share"] for row in shares if row["head"] == 1} == {0.0}
    agent = trainer.agent(state)
    acting = agent.init(1, key=jax.random.key(0))
    for obs in data[0].obs[:3]:
        acting, decision = agent.act(acting, obs[None])
        assert np.isfinite(decision.action).all()
