"""Recordings: what is read of them, where they are cut, what is refused, and runs made of them."""

import json
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

import headway
import runs
from headway import task
from headway.cli import main
from headway.errors import ConfigError, HeadwayError
from headway.training import recordings
from headway.training.recordings import export_data, read_log
from headway.training.run import RunDir
from headway.training.trainers import Trainer


def register(name, env_id, make_task, sets):
    own = {"name": name, "env_id": env_id, "make_task": make_task, "sim_params": sets}
    headway.register(headway.EnvSpec(**own, episode_length=50, default_sim_params={"mass": 1.0}))


@pytest.fixture
def unchecked(monkeypatch):
    """Nothing is traced, which takes a second each time."""
    monkeypatch.setattr(recordings, "compared", lambda task, pieces: ())
    monkeypatch.setattr(recordings, "method_findings", lambda task: ())


SETTINGS = {**runs.TINY, "collection.num_iterations": 2, "collection.episode_length": 30}


def recording(steps=25, seed=0):
    """Numbers as another program may log them: a row a step, the last one without an action."""
    rng = np.random.default_rng(seed)
    angle = np.cumsum(rng.normal(size=steps + 1)) / 9
    obs = np.stack([np.cos(angle), np.sin(angle), rng.normal(size=steps + 1)], -1)
    return {"obs": obs, "action": rng.uniform(-2, 2, (steps, 1))}


def read(data, held_out=0.0, names=None, env="pendulum"):
    config = headway.make_config(env, preset="smoke", settings=SETTINGS)
    return read_log(data, config, held_out, names or {})


def lengths(log):
    return [len(piece) for piece in log.fitted]


def changed(**changes):
    """A recording with other columns; a function changes one, None leaves one out."""
    made = recording()
    for name, change in changes.items():
        made[name] = change(made[name]) if callable(change) else change
    return {name: value for name, value in made.items() if value is not None}


def with_nan(rows):
    def change(values):
        values = values.copy()
        values[rows] = np.nan
        return values

    return change


def tail_flag(row, steps=25):
    return np.arange(steps) == row


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("table", "pieces", "files"),
    [
        (changed(), [25], 1),
        (changed(obs=lambda obs: obs[:-1]), [24], 1),
        (changed(obs=with_nan([10])), [9, 14], 1),
        (changed(action=with_nan([10, 24])), [10, 13], 1),
        (changed(time=np.arange(26) * 0.05 + (np.arange(26) > 10)), [10, 14], 1),
        (changed(time=np.datetime64("2026-01-01") + 50 * np.arange(25)), [25], 1),
        (changed(step=np.arange(26) % 13), [12, 12], 2),
        (changed(episode=["a"] * 6 + ["b"] * 20), [5, 19], 2),
        (changed(terminated=tail_flag(9)), [10, 15], 2),
        (changed(terminated=True), [25], 1),
        (changed(obs=lambda obs: obs[:-1], terminated=True), [24], 1),
        (changed(obs=lambda obs: obs[:-1], dones=tail_flag(9)), [9, 14], 2),
        (changed(**{"sim_params.length": np.repeat([0.5, 1.0], 13)}), [12, 12], 2),
        (recording(70), [30, 30, 10], 1),
    ],
)
def test_recordings_are_cut_where_they_must_be(table, pieces, files):
    log = read([table])
    assert lengths(log) == pieces
    assert len(log.recordings) == files
    found = np.concatenate([piece.action for piece in log.fitted])
    whole = np.asarray(table["action"], np.float32) / 2  # in [-1, 1]
    assert np.isin(found, whole).all()
    for piece in log.fitted:  # every observation follows the one before it
        at = np.flatnonzero((whole == piece.action[0]).all(1))[0]
        np.testing.assert_allclose(piece.obs, table["obs"][at : at + len(piece) + 1], rtol=1e-6)


def test_cuts_are_said_and_rewards_that_are_missing_are_the_tasks():
    reward = np.full(25, np.nan)
    reward[3], reward[4] = -7.0, np.inf
    log = read([changed(obs=with_nan([10]), reward=reward)])
    assert log.remarks[0] == "cut at 1 rows with missing numbers: 1 recordings, 2 pieces."
    assert log.remarks[1].startswith("reward: Task.reward is ")
    (piece, _), law = log.fitted, headway.env_spec("pendulum").make_task()
    obs, action = jnp.asarray(piece.obs), jnp.asarray(piece.action)
    due = law.reward(obs[:-1], 2 * action, obs[1:])
    found = piece.reward[[0, 3, 4, 8]]
    np.testing.assert_allclose(found, [due[0], -7, due[4], due[8]], rtol=1e-5)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("table", "names", "text"),
    [
        ({"x": [1]}, {}, "data[0] has no obs, allowed: x; choose by --names obs=NAME"),
        (changed(), {"obs": "q,v"}, "data[0] has no q, v, allowed: obs, action"),
        (changed(), {"rewards": "q"}, "Did you mean"),
        (changed(obs=np.zeros((26, 2))), {}, "a row of obs has 2 numbers, allowed: 3"),
        (changed(action=np.zeros((9, 1))), {}, "has 26 obs and 9 actions, allowed"),
        (changed(action=np.full((25, 1), 2.5)), {}, "action[0] is 2.5 in row 0, allowed: -2 to 2"),
        (changed(obs=np.full((26, 3), "a")), {}, "obs cannot be read: could not convert string"),
        ({"x": [1, 2], "y": [1], "action": [0]}, {"obs": "x,y"}, "data[0]: obs cannot be read: "),
        (changed(time=np.arange(7)), {}, "time has 7 rows, allowed: 1, 25 or 26"),
        (changed(obs=with_nan(slice(None, None, 2))), {}, "have no transition"),
        (changed(**{"sim_params.lenght": 1}), {}, "Did you mean 'sim_params.length'?"),
    ],
)
def test_what_does_not_fit_is_one_line(table, names, text):
    with pytest.raises(HeadwayError) as refused:
        read([table], names=names)
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ["empty.npz", "text.parquet", "objects.npz", "nothing"])
def test_files_that_cannot_be_read_are_named(name, tmp_path):
    path = tmp_path / name
    if name == "objects.npz":
        np.savez(path, obs=np.array([{}], object))
    elif name != "nothing":
        path.write_bytes(b"" if name == "empty.npz" else b"PAR0, perhaps")
    with pytest.raises(ConfigError, match=f"{name} (cannot be read|holds no recordings)"):
        read(tmp_path / name)


@pytest.mark.usefixtures("unchecked")
def test_files_of_another_maker_give_the_same_pieces(tmp_path):
    """Parquet by lists and by scalars, with blanks and texts; .npz in other types and names."""
    made = recording()
    expected = read([made]).fitted[0]
    obs, action = made["obs"], np.append(made["action"], [[np.nan]], 0)
    as_lists = {"observation": obs.tolist(), "action": [*action[:-1].tolist(), None]}
    by_number = {name: obs[:, i] for i, name in enumerate(["cos", "sin", "speed"])}
    scalars = {**by_number, "torque": [*action[:-1, 0].tolist(), None]}
    camera = pyarrow.array(["front", "left"] * 13).dictionary_encode()
    parquet.write_table(pyarrow.table(as_lists | {"camera": camera}), tmp_path / "a.parquet")
    parquet.write_table(pyarrow.table(scalars), tmp_path / "b.parquet")
    np.savez(tmp_path / "c.npz", states=obs, actions=action[:-1])
    names = {"obs": "cos,sin,speed", "action": "torque"}
    for file, asked in (("a.parquet", {}), ("b.parquet", names), ("c.npz", {})):
        (piece,) = read(tmp_path / file, names=asked).fitted
        np.testing.assert_array_equal(piece.obs, expected.obs)
        np.testing.assert_array_equal(piece.action, expected.action)


@pytest.mark.usefixtures("unchecked")
def test_recordings_are_held_out_whole():
    table = changed(obs=with_nan([10]))
    log = read([table] * 10, held_out=0.3)
    parts = log.fitted, log.held_out
    numbers = [{piece.sim_params["recording"] for piece in part} for part in parts]
    assert [len(part) for part in numbers] == [7, 3]
    assert not numbers[0] & numbers[1]
    assert [row["held_out"] for row in log.recordings].count(True) == 3
    alone = read([recording(90)], held_out=0.3)
    assert (len(alone.fitted), len(alone.held_out)) == (2, 1)


class Push(headway.Task):
    """A machine of which there is no environment, so that its Task states all."""

    obs_size: ClassVar[int] = 1
    action_size: ClassVar[int] = 1
    action_low: ClassVar[tuple[float, ...]] = (-1.0,)
    action_high: ClassVar[tuple[float, ...]] = (1.0,)

    def reward(self, obs, action, next_obs):
        return -jnp.square(next_obs[..., 0])


def no_environment(**options):
    raise RuntimeError("there is none")


def test_a_task_is_enough_where_no_environment_can_be_made(monkeypatch):
    monkeypatch.setattr(task, "_registered", {})
    sets = headway.SimParamSets({"mass": [1.0]})
    register("push", no_environment, Push, sets)
    log = read(
        [{"x": np.arange(9.0), "u": np.zeros(9)}], names={"obs": "x", "action": "u"}, env="push"
    )
    assert lengths(log) == [8]
    assert log.config.spaces.obs_size == 1
    np.testing.assert_allclose(log.fitted[0].reward, -(np.arange(1, 9.0) ** 2))


class Pole(headway.Task):
    """Paid for every step."""

    def reward(self, obs, action, next_obs):
        return jnp.ones(obs.shape[:-1])


@pytest.mark.usefixtures("unchecked")
def test_categories_are_numbers_in_a_recording(monkeypatch):
    monkeypatch.setattr(task, "_registered", {})
    sets = headway.SimParamSets({"mass": [1.0]})
    register("pole", "CartPole-v1", Pole, sets)
    log = read([{"obs": np.zeros((4, 4)), "action": [0, 1, 1], "terminated": 1}], env="pole")
    np.testing.assert_array_equal(log.fitted[0].action, [[1, -1], [-1, 1], [-1, 1]])
    assert log.fitted[0].terminated
    with pytest.raises(ConfigError, match=r"action\[0\] is 0\.5 in row 1, allowed: 0 to 1"):
        read([{"obs": np.zeros((4, 4)), "action": [0, 0.5, 1]}], env="pole")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of recordings."""
    path = tmp_path_factory.mktemp("recordings")
    for seed in range(5):
        np.savez(path / f"{seed}.npz", **recording(28, seed))
    return path


@pytest.fixture(scope="module")
def fitted(folder, tmp_path_factory):
    """A run of them."""
    path = tmp_path_factory.mktemp("runs") / "fit"
    return headway.fit(folder, "pendulum", preset="smoke", run_dir=path, settings=SETTINGS)


def test_a_fit_is_a_run(fitted, folder, capsys):
    assert not fitted.evaluation
    first, last = fitted.metrics
    assert [row["transitions"] for row in first["recordings"]] == [28] * 5
    assert last["timesteps"] == 4 * 28
    assert len(last["held_out_error"]) == SETTINGS["planner.horizon"]
    assert RunDir(fitted.path).config().log["rounds"] == 2
    owned = {row["sim_params"] for row in RunDir(fitted.path).assignments()}
    assert len(owned) == 4
    assert headway.load(fitted.path).act(np.array([1.0, 0.0, 0.0])).shape == (1,)
    assert headway.diagnose(fitted.path).episodes.keys() == {"held-out"}
    assert len(headway.evaluate(fitted.path, num_episodes=1)) == 3
    assert "held-out" in headway.write_report([fitted.path], fitted.path / "r.html").read_text()
    command = ["fit", str(folder), "--task", "pendulum", "--preset", "smoke"]
    asked = [f"--{name}={value}" for name, value in SETTINGS.items() if "sizes" not in name]
    sizes = ["--model.hidden-sizes", "8", "8", "--model.context-hidden-sizes", "8"]
    assert main([*command, *asked, *sizes, "--run-dir", str(fitted.path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["held_out_error"] == last["held_out_error"]
    assert all(len(row["heads"]) == 2 for row in facts["recordings"])


def test_other_recordings_are_another_run(fitted, folder):
    settings = {"preset": "smoke", "run_dir": fitted.path, "settings": SETTINGS}
    with pytest.raises(headway.RunError, match=r"log\.sha256"):
        headway.fit([recording()], "pendulum", **settings)
    again = headway.fit(folder, "pendulum", **settings)
    assert again.metrics == fitted.metrics


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("change", [{"sim_params.length": 0.5}, {"terminated": True}], ids=str)
def test_recordings_with_other_labels_are_other_recordings(change):
    labelled = {"sim_params.length": 1.0, "terminated": False}
    logs = [read([recording() | labels]) for labels in (labelled, labelled, labelled | change)]
    first, again, other = (log.config.log["sha256"] for log in logs)
    assert first == again != other


@pytest.mark.usefixtures("unchecked")
def test_physics_that_the_model_is_told_are_asked_for_before_anything_is_written(tmp_path):
    with pytest.raises(ConfigError, match=r"lack length, mass"):
        headway.fit(
            [recording()], "pendulum", method="oracle-params", preset="smoke", run_dir=tmp_path
        )
    assert not list(tmp_path.iterdir())


def test_a_fit_whose_imagination_explodes_is_saved(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(Trainer, "prediction_error", lambda *_: np.array([0.5, np.inf, np.nan]))
    given = {"preset": "smoke", "run_dir": tmp_path, "settings": SETTINGS}
    errors = headway.fit(folder, "pendulum", **given).metrics[-1]["held_out_error"]
    assert errors[0] == 0.5
    assert errors[1] == errors[2] > 1e38


def test_training_goes_on_from_a_fit(fitted):
    run = headway.train("pendulum", from_run=fitted.path)
    assert run.path == fitted.path.with_name("fit-on")
    kinds = ["collection" in row for row in run.metrics]
    assert kinds == [False, False, True, True]
    assert run.metrics[2]["timesteps"] == 4 * 28 + 2 * 30
    assert {row.group for row in run.evaluation} == {"train", "low", "high"}
    with pytest.raises(ConfigError, match="allowed: 'pendulum'"):
        headway.train("hopper", from_run=fitted.path)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("planner.horizon", 9, "changed is planner.horizon: . -> 9"),
        ("collection.num_iterations", 2, "num_iterations is 2 and changed is nothing"),
        ("collection.num_iterations", 1, "changed is collection.num_iterations: 2 -> 1"),
    ],
)
def test_what_cannot_go_on_from_a_fit_is_refused_before_it_is_copied(
    fitted, tmp_path, name, value, said
):
    given = {"run_dir": tmp_path / "on", "settings": {name: value}}
    allowed = "allowed: more iterations than 2, and the settings of"
    with pytest.raises(ConfigError, match=f"{said}, {allowed}"):
        headway.train("pendulum", from_run=fitted.path, **given)
    assert not (tmp_path / "on").exists()


def test_what_is_exported_is_read_back(reference, tmp_path):
    count = export_data(reference, tmp_path / "pendulum-v0")
    data = RunDir(reference).load_data()
    assert count == len(data)
    log = read(tmp_path / "pendulum-v0")
    assert not log.remarks
    for back, episode in zip(log.fitted, data, strict=True):
        np.testing.assert_array_equal(back.obs, episode.obs)
        np.testing.assert_allclose(back.action, episode.action, atol=1e-6)
        np.testing.assert_array_equal(back.reward, episode.reward)
        assert dict(episode.sim_params).items() <= dict(back.sim_params).items()
    with pytest.raises(ConfigError, match="with a version at its end"):
        export_data(reference, tmp_path / "pendulum")
