"""Films: the picture, the physics in force and the heads that planned, step by step."""

import functools
import io

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image, ImageColor

import misbehaving
from headway import cli
from headway.config import PlannerConfig
from headway.envs import ClassicVectorEnv
from headway.errors import BadEnvironmentError, ConfigError, HeadwayError
from headway.lab import record as lab
from headway.lab.figures import FAINT, HEADS, INK
from headway.lab.record import LINE, MARGIN, TRACE, WIDTH, Recording, film
from headway.planning.agent import Agent
from headway.sim_params import SimParamSets, Uniform
from headway.task import EnvSpec, register, task_of
from headway.training.methods import make_config
from headway.training.run import RunDir
from headway.worlds.classic import PendulumTask

SCENE = (240, 320)


def moment(step, length=1.0, heads=(0, 1), action=(0.5,), reward=-1.0):
    image = np.full((*SCENE, 3), 250, np.uint8)
    image[step % 200 : step % 200 + 4] = (200, 40, 40)
    chosen = None if heads is None else np.array(heads)
    physics = {"length": length}
    return lab.Moment(image, physics, np.array(action), reward, chosen)


def frames(content):
    film_ = Image.open(io.BytesIO(content))
    shown = []
    for index in range(film_.n_frames):
        film_.seek(index)
        shown.append((np.asarray(film_.convert("RGB")).astype(int), film_.info["duration"]))
    return shown


def near(image, color):
    """Pixels of a colour, as far as a palette keeps it."""
    return (np.abs(image - np.array(ImageColor.getrgb(color))).sum(-1) < 40).nonzero()


def test_a_film_runs_at_the_speed_of_the_environment():
    for speed, count, duration in ((20.0, 10, 50), (100.0, 4, 40)):  # steps 0, 4, 8 and the last
        shown = frames(film([moment(step) for step in range(10)], speed, ".gif"))
        assert len(shown) == count
        assert {lasts for _, lasts in shown[:-1]} == {duration}


def test_a_film_is_mp4_too():
    content = film([moment(step) for step in range(10)], 20.0, ".mp4")
    images = iio.imread(content, extension=".mp4", plugin="FFMPEG")
    assert len(images) == 10 + 30  # the end stands for a second and a half
    assert images.shape[2] == WIDTH
    expected = frames(film([moment(0)], 20.0, ".gif"))[0][0]
    assert np.abs(images[0].astype(int) - expected).mean() < 10  # both reduce colours


def test_strips_show_who_planned_until_now():
    heads = [(0, 1)] * 10 + [(2, 1)] * 10
    shown = frames(film([moment(i, heads=h) for i, h in enumerate(heads)], 20.0, ".gif"))
    first, last = shown[0][0], shown[-1][0]
    bottom = WIDTH * SCENE[0] // SCENE[1]
    widths = []
    for color in HEADS[:3]:
        rows, columns = near(last[bottom:], color)
        widths.append((np.ptp(columns) + 1, rows.min()))
        assert len(near(first[bottom:], color)[0]) < len(rows)
    wide = WIDTH - 2 * MARGIN
    # Head 1 planned all the time, in the second row; heads 0 and 2 half of it each, in the first.
    assert widths[1][0] == pytest.approx(wide, abs=3)
    assert widths[0][0] == pytest.approx(wide / 2, abs=3)
    assert widths[2][0] == pytest.approx(wide / 2, abs=3)
    assert widths[0][1] == widths[2][1] < widths[1][1]


def test_a_line_marks_where_the_physics_changed():
    steps = [moment(i, length=1.0 if i < 5 else 0.5) for i in range(10)]
    last = frames(film(steps, 20.0, ".gif"))[-1][0]
    dark = len(last) - WIDTH * SCENE[0] // SCENE[1]  # below the scene
    columns, counts = np.unique(near(last[-dark:], INK)[1], return_counts=True)
    assert columns[counts.argmax()] == pytest.approx(WIDTH / 2, abs=3)


def test_traces_show_actions_and_rewards_until_now():
    up = [moment(i, heads=None, action=(i / 9, -i / 9), reward=float(i)) for i in range(10)]
    shown = [frame for frame, _ in frames(film(up, 20.0, ".gif"))]
    bottom = WIDTH * SCENE[0] // SCENE[1] + MARGIN + LINE  # below the scene and its caption
    rows, columns = near(shown[-1][bottom:], INK)
    for trace in (rows < rows.max() - TRACE, rows >= rows.max() - TRACE):  # an action, the reward
        heights = [rows[trace & (columns == x)].mean() for x in (WIDTH // 4, WIDTH // 2)]
        assert heights[1] < heights[0] - TRACE / 8
    assert near(shown[-1][bottom:], FAINT)[1].max() > WIDTH * 0.9  # the other action
    assert near(shown[4][bottom:], INK)[1].max() < WIDTH * 0.6


def test_without_heads_there_are_no_strips():
    plain = frames(film([moment(i, heads=None) for i in range(3)], 20.0, ".gif"))[0][0]
    with_heads = frames(film([moment(i) for i in range(3)], 20.0, ".gif"))[0][0]
    assert len(plain) < len(with_heads)


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    """A run whose agent acts at random."""
    monkeypatch.setattr(
        lab, "load_agent", lambda run, config, **_: Agent(None, task_of(config), PlannerConfig())
    )
    run = RunDir(tmp_path / "run")
    run.begin(make_config("pendulum", preset="smoke"))
    return run.path


def test_an_episode_is_filmed_under_the_physics_that_were_asked_for(run_dir, tmp_path):
    def film_it(name, **asked):
        return lab.record(run_dir, tmp_path / name, seed=3, **asked)

    asked = {"sim_params": {"length": 1.75}, "schedule": {4: {"mass": 2.0}}, "num_steps": 8}
    found = film_it("a.gif", **asked)
    assert (found.env, found.steps) == ("pendulum", 8)
    assert found.sim_params == {"length": 1.75, "mass": 2.0, "gain": 1.0}
    assert Image.open(found.path).n_frames == 8
    again = film_it("b.gif", **asked)
    assert again.path.read_bytes() == found.path.read_bytes()
    assert again.episode_return == found.episode_return
    other = film_it("c.gif")
    assert other.sim_params["length"] in (0.5, 0.75, 1.0, 1.25)  # training physics
    assert other.episode_return != found.episode_return
    assert other.steps == make_config("pendulum", preset="smoke").collection.episode_length


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"output": "film.avi"}, "film.avi cannot be a film, allowed: names ending in .gif"),
        ({"num_steps": 0}, "num_steps is 0"),
        ({"sim_params": {"lenth": 1.0}}, "Did you mean 'length'"),
        ({"schedule": {1: {"mass": -1.0}}}, "mass"),
        ({"schedule": {2: {"mass": 1.0}}}, "schedule has step 2, allowed: below 2"),
        ({"settings": {"model.num_heads": 1}}, "model.num_heads"),
    ],
)
def test_what_cannot_be_filmed_is_refused_and_nothing_is_written(asked, reason, run_dir, tmp_path):
    asked = {"output": tmp_path / "film.gif", "num_steps": 2} | asked
    with pytest.raises(ConfigError, match=reason):
        lab.record(run_dir, **asked)
    assert not list(tmp_path.glob("*.gif"))


@pytest.mark.parametrize(("frame", "name"), [(None, "NoneType"), (np.ones((8, 8, 3)), "float64")])
def test_an_environment_that_draws_no_image_is_named(frame, name, run_dir, tmp_path, monkeypatch):
    monkeypatch.setattr(ClassicVectorEnv, "frame", lambda self, i: frame)
    with pytest.raises(BadEnvironmentError, match=f"gave {name}, allowed: an image"):
        lab.record(run_dir, tmp_path / "film.gif", num_steps=2)


@pytest.fixture
def own(run_dir, tmp_path):
    """Begins a run on an environment of one's own."""

    def begin(make_env, **changes):
        sets = SimParamSets({"drift": Uniform(0.5, 1)}, {"far": {"drift": (3.0,)}})
        own = {"name": "own", "env_id": make_env, "make_task": PendulumTask, "options": {"how": ""}}
        register(EnvSpec(**own, sim_params=sets, episode_length=20))
        run = RunDir(tmp_path / "own")
        run.begin(make_config("own", preset="smoke", settings=changes))
        return run.path

    return begin


@pytest.mark.parametrize("processes", [False, True])
def test_a_film_shows_the_environment_with_its_wrappers(own, tmp_path, processes):
    path = own(misbehaving.wrapped, **{"collection.env_processes": processes})
    asked = {"sim_params": {"drift": 0.5}, "schedule": {3: {"drift": 4.0}}}
    found = lab.record(path, tmp_path / "film.gif", **asked)
    assert (found.steps, found.episode_return, found.sim_params) == (12, 84.0, {"drift": 4.0})


@pytest.mark.parametrize(
    ("make_env", "how", "drift", "says"),
    [
        (misbehaving.Drift, "", "drift", "TypeError at creation with render_mode, to be filmed"),
        (misbehaving.wrapped, "give_up", "drift", "at step 3: .*the robot fell apart"),
        (functools.partial(misbehaving.wrapped, at=0), "give_up", "drift", "at reset: .*apart"),
        (misbehaving.wrapped, "", "drif", "Did you mean 'drift'"),
    ],
)
def test_own_environments_that_cannot_be_filmed(own, tmp_path, make_env, how, drift, says):
    path = own(make_env, env_options={"how": how})
    with pytest.raises(HeadwayError, match=says):
        lab.record(path, tmp_path / "film.gif", sim_params={drift: 1.0})
    assert not (tmp_path / "film.gif").exists()


def test_the_command_line_reads_physics_and_schedule(run_dir, tmp_path, monkeypatch, capsys):
    calls = []

    def record(run, output, **asked):
        calls.append(asked)
        return Recording(output, "pendulum", {"length": 1.0}, 5, -7.25)

    monkeypatch.setattr(lab, "record", record)
    words = [
        "--sim-params",
        "length=1.75",
        "m [kg]=2",
        "--schedule",
        "60:length=0.5",
        "60:mass=2",
        "90:mass=1",
    ]
    code = cli.main(["record", str(run_dir), *words, "--planner.horizon", "7", "--quiet"])
    assert code == 0
    assert calls[0]["sim_params"] == {"length": 1.75, "m [kg]": 2.0}
    assert calls[0]["schedule"] == {60: {"length": 0.5, "mass": 2.0}, 90: {"mass": 1.0}}
    assert calls[0]["settings"] == {"planner.horizon": 7}
    assert capsys.readouterr().out == "episode.gif: 5 steps, return -7.2\n"
    for wrong in (["--schedule", "length=2"], ["--schedule", "5:length"], ["--sim-params", "x"]):
        assert cli.main(["record", str(run_dir), *wrong]) == 1
    assert capsys.readouterr().err.count("error: ") == 3
