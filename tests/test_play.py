"""The live player: its loop without a page, the run that ships, and the page in a browser."""

import itertools
import re
import threading
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import headway
from headway import task
from headway.cli import main
from headway.errors import BrokenEpisodeError, ConfigError
from headway.play.page import SHIPPED, Page, play
from headway.play.player import Player
from headway.sim_params import SimParamSets, Uniform
from headway.task import EnvSpec
from headway.training.methods import KEEP_LEARNING
from headway.training.run import RunDir
from toys import PointTask


class Lamp(gymnasium.Env):
    """An environment of one's own: a light that follows the action, with a picture."""

    observation_space = gymnasium.spaces.Box(-9, 9, (PointTask.obs_size,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (PointTask.action_size,), np.float32)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    fragile = False

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.power, self.steps = options["sim_params"]["power"], 0
        return self.observe(), {}

    def observe(self):
        return np.full(PointTask.obs_size, self.power * self.steps % 9, np.float32)

    def step(self, action):
        self.steps += 1
        if self.fragile and self.steps == 3:
            raise BrokenEpisodeError("blown")
        return self.observe(), 0.0, self.steps == 6, False, {}

    def render(self):
        return np.full((60, 80, 3), 200, np.uint8) if self.render_mode else None


class DimmableLamp(Lamp):
    """A lamp whose power can be changed while it shines."""

    def set_sim_params(self, values):
        self.power = values["power"]


def lamp(tmp_path, monkeypatch, cls=Lamp, power=Uniform(1, 2), weak=0.5):  # noqa: B008
    """A run with a lamp that acts at random."""
    monkeypatch.setattr(task, "_registered", dict(task._registered))
    sets = SimParamSets({"power": power}, {"weak": {"power": [weak]}})
    own = {"name": "lamp", "env_id": cls, "make_task": PointTask, "episode_length": 6}
    headway.register(EnvSpec(**own, sim_params=sets))
    settings = {"collection.check": False, "collection.num_iterations": 1}
    run = headway.train(
        "lamp", method="random", preset="smoke", run_dir=tmp_path / "run", settings=settings
    )
    return run.path


@pytest.fixture(scope="module")
def pendulum():
    player = Player(SHIPPED)
    yield player
    player.environments.close()


def test_the_run_that_ships_is_one_like_any_other():
    RunDir(SHIPPED).check()
    assert sum(file.stat().st_size for file in SHIPPED.rglob("*") if file.is_file()) < 2e6
    tested = headway.evaluate(SHIPPED, groups=["train"], num_episodes=4)
    assert np.mean([row.episode_return for row in tested]) > -300  # random actions: -1300


def test_a_length_that_changes_changes_the_heads_within_a_second(pendulum):
    pendulum.set_sim_params({"length": 1.0})
    pendulum.reset(0)
    for _ in range(100):
        pendulum.step()
    assert pendulum.obs[0] > 0.9  # upright
    for length in (0.5, 1.25, 0.75):
        before = pendulum.controller.heads
        pendulum.set_sim_params({"length": length})
        for _ in range(20):
            pendulum.step()
        assert (pendulum.controller.heads != before).all()
        assert [moment.changed for moment in pendulum.moments][-20:] == [True] + [False] * 19


def test_predictions_meet_what_happens_until_it_is_pushed(pendulum):
    pendulum.set_sim_params({"length": 1.0})
    pendulum.reset(0)
    for _ in range(100):
        pendulum.step()
    errors = [abs(m.imagined[0] - m.obs).max() for m in list(pendulum.moments)[20:]]
    assert np.median(errors) < 0.05
    plan = pendulum.moments[-1].imagined
    assert plan.shape == (pendulum.config.planner.horizon, 3)
    spin, expected = pendulum.obs[2], plan[1, 2]
    pendulum.push(3.0)
    assert pendulum.obs[2] == pytest.approx(spin + 3.0, abs=1e-5)
    pendulum.step()
    assert abs(pendulum.obs[2] - expected) > 1.0


def test_the_planner_changes_while_it_plays(pendulum):
    pendulum.reset(0)
    pendulum.switch({"planner.optimizer.name": "ilqr", **KEEP_LEARNING})
    pendulum.step()
    assert pendulum.controller.agent.planner.optimizer.name == "ilqr"
    assert len(pendulum.moments) == 1
    with pytest.raises(ConfigError, match="optimizer"):
        pendulum.switch({"planner.optimizer.name": "luck"})
    pendulum.switch({})


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        ("pendulum", {"length": Uniform(0.25, 1.75), "gain": (-1.0, 1.0)}),
        ("half-cheetah", {"mass_scale": Uniform(0.1, 3.0)}),
        ("crippled-ant", {"crippled_leg": (-1.0, 0.0, 1.0, 2.0, 3.0)}),
    ],
)
def test_what_can_be_chosen_is_what_varies(tmp_path, env, expected):
    settings = {"collection.episode_length": 5, "collection.num_iterations": 1}
    run = headway.train(env, method="random", preset="smoke", run_dir=tmp_path, settings=settings)
    player = Player(run.path)
    assert player.ranges == expected
    for name, values in expected.items():
        value = values.high if isinstance(values, Uniform) else values[-1]
        player.set_sim_params({name: value})
        assert player.env.physics(0)[name] == value
    player.step()
    before = player.obs
    player.push(1.0)
    assert (player.obs != before).any()
    player.environments.close()


def test_a_range_of_whole_numbers_is_an_amount(tmp_path, monkeypatch):
    player = Player(lamp(tmp_path, monkeypatch, power=Uniform(-2, 2), weak=-3.0))
    assert player.ranges == {"power": Uniform(-3.0, 2.0)}
    player.environments.close()


def test_heads_that_learn_can_be_stopped_on_the_page_and_learn_again(tmp_path):
    pytest.importorskip("viser", reason="no viser: pip install 'headway[play]'")
    settings = {"collection.num_iterations": 1, "planner.change_threshold": 7.0}
    run = headway.train(
        "pendulum", method="tmcl-bayes", preset="smoke", run_dir=tmp_path, settings=settings
    )
    player = Player(run.path)
    page = Page(player, "127.0.0.1", 8400)
    assert page._learn.value
    for learn, adaptation in ((False, "none"), (True, "last-layer")):
        page._learn.value = learn
        page._switch()
        assert player.controller.agent.planner.adaptation == adaptation
    assert player.controller.agent.planner.change_threshold == 7.0
    page.server.stop()
    player.environments.close()


def test_the_clock_steps_pauses_and_does_what_is_asked(tmp_path, monkeypatch):
    player, seen = Player(lamp(tmp_path, monkeypatch)), []
    player.speed = 4.0

    def show():
        seen.append((len(player.moments), player.paused))
        if len(seen) == 3:
            player.ask(lambda: setattr(player, "paused", True))
        if player.paused:
            player.stopped = True

    player.run(show)
    assert [count for count, _ in seen[:3]] == [1, 2, 3]
    assert seen[-1][1]
    assert len(seen) <= 5
    assert 0 < player.pace < 1.5


def test_nothing_moves_while_nobody_looks(tmp_path, monkeypatch):
    player, looks = Player(lamp(tmp_path, monkeypatch)), iter([False] * 5 + [True] * 9)

    def show():
        player.stopped = len(player.moments) == 3

    def watched():
        look = next(looks)
        assert look or len(player.moments) == 1
        return look

    player.run(show, watched)
    assert len(player.moments) == 3


@pytest.mark.parametrize("cls", [Lamp, DimmableLamp])
def test_an_own_environment_changes_at_once_or_begins_again(tmp_path, monkeypatch, cls):
    player = Player(lamp(tmp_path, monkeypatch, cls))
    assert player.ranges == {"power": Uniform(0.5, 2.0)}
    player.step()
    player.set_sim_params({"power": 2.0})
    assert len(player.moments) == (cls is DimmableLamp)
    player.step()
    assert player.obs[0] == (4.0 if cls is DimmableLamp else 2.0)
    for _ in range(6):
        player.step()
    assert "ended" in player.message
    player.environments.close()


def test_an_episode_that_breaks_is_said_and_begun_again(tmp_path, monkeypatch):
    player = Player(lamp(tmp_path, monkeypatch))
    monkeypatch.setattr(Lamp, "fragile", True)
    for _ in range(3):
        player.step()
    assert player.message == "lamp broke: blown"
    assert not player.moments


def test_what_cannot_be_played_is_one_line(tmp_path, monkeypatch, capsys):
    assert main(["play", str(tmp_path / "nothing")]) == 1
    assert "allowed: a run directory" in capsys.readouterr().err
    refused = r"host is 'nowhere\.invalid' .*, allowed: an IPv4 address"
    with pytest.raises(ConfigError, match=refused):
        play(host="nowhere.invalid")
    monkeypatch.setattr("headway.errors.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"viser, mjviser not installed.*headway\[play\]"):
        play()


@pytest.fixture
def served(tmp_path, monkeypatch, request):
    """A player and its page, running in a thread until the test is over."""
    pytest.importorskip("viser", reason="no viser: pip install 'headway[play]'")
    pytest.importorskip("mjviser", reason="no mjviser: pip install 'headway[play]'")
    kind, settings = request.param, {"collection.episode_length": 5}
    if kind == "shipped":
        run = SHIPPED
    elif kind == "lamp":
        run = lamp(tmp_path, monkeypatch)
    else:
        run = headway.train(
            kind, method="random", preset="smoke", run_dir=tmp_path, settings=settings
        ).path
    player = Player(run)
    shown = Page(player, "127.0.0.1", 8300)
    # Reflections take half a minute where there is no GPU.
    shown.server.scene.configure_environment_map(None)
    thread = threading.Thread(target=player.run, args=[shown.show, shown.server.get_clients])
    thread.start()
    yield SimpleNamespace(player=player, address=shown.address)
    player.stopped = True
    thread.join()
    shown.server.stop()
    player.environments.close()


@pytest.mark.parametrize(
    "served", ["shipped", "cartpole-swingup", "crippled-ant", "lamp"], indirect=True
)
def test_the_page_shows_and_changes_what_is_played(browser, served):
    player, errors = served.player, []
    tab = browser.new_page(viewport={"width": 800, "height": 500})
    tab.set_default_timeout(30_000)
    tab.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("request", lambda asked: errors.append(asked.url) if alien(asked.url) else None)
    tab.goto(served.address)
    tab.get_by_text("planning ").filter(has_text="reward").first.wait_for()
    before = dict(player.sim_params)
    if player.spec.name == "crippled-ant":
        tab.get_by_label("crippled_leg").or_(tab.locator("input[value='-1']")).first.click()
        tab.get_by_role("option", name="2", exact=True).click()
        wait_until(lambda: player.env.physics(0)["crippled_leg"] == 2)
    else:
        thumb = tab.get_by_role("slider").first
        thumb.focus()
        for _ in range(5):
            thumb.press("ArrowRight")
        wait_until(lambda: player.sim_params != before)
    tab.get_by_role("button", name="pause").click()
    tab.get_by_text("paused").first.wait_for()
    before = [*map(id, player.moments)]
    tab.get_by_role("button", name="step").click()
    wait_until(lambda: [*map(id, player.moments)] != before)
    assert tab.locator("canvas").first.is_visible()
    if player.spec.name == "pendulum":
        assert tab.locator(".heads rect").count() > 5
    tab.get_by_role("button", name="reset").click()
    tab.locator("p").filter(has_text=re.compile("^paused$")).wait_for()  # no step, no reward
    tab.close()
    assert not errors


def alien(url):
    return not url.startswith(("http://127.0.0.1", "ws://127.0.0.1", "data:", "blob:"))


def wait_until(true):
    for _ in itertools.takewhile(lambda _: not true(), range(600)):
        threading.Event().wait(0.05)
    assert true()
