"""What the README and the guides show works as it stands there."""

import operator
import re
import sys
import types
from pathlib import Path

import jax.numpy as jnp
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import headway
from headway import task
from headway.cli import COMMANDS, main
from headway.config import MODELS, OwnModelConfig, known_settings
from headway.errors import ConfigError
from headway.training import methods, trainers
from headway.training.run import RunDir
from headway.training.trainers import load_agent

ROOT = Path(__file__).parent.parent


def python_blocks(path: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / path).read_text(), re.DOTALL)


def test_readme_python(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (code,) = python_blocks("README.md")
    assert len([line for line in code.splitlines() if line]) <= 12
    exec(compile(code, "README.md", "exec"), {})
    assert "'length': 1.75" in capsys.readouterr().out
    assert (tmp_path / "runs/readme/evaluation.csv").exists()


@pytest.fixture(scope="module")
def guide(tmp_path_factory):
    """What the guide to own environments defines, its run small; its folder is the current one."""
    package, learned = python_blocks("docs/own-environment.md")
    names: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "_registered", dict(task._registered))
        patch.chdir(tmp_path_factory.mktemp("guide"))
        exec(compile(package, "my_package.py", "exec"), names)
        module = types.ModuleType("my_package")
        vars(module).update(names)
        patch.setitem(sys.modules, "my_package", module)
        exec(learned.replace("quick", "smoke"), names)
        names["learned"] = names["run"]
        names["run"] = headway.train("my_package:cart", preset="smoke", run_dir="runs/cart")
        yield names


def test_own_environment_guide(guide):
    for run, learned in ((guide["run"], False), (guide["learned"], True)):
        assert {row.group for row in run.evaluation} == {"train", "heavy"}
        assert run.config.model.learned_reward is learned
    obs = np.array([0.5, 0.0], np.float32)
    task = headway.env_spec("my_package:cart").make_task()
    assert jnp.isclose(task.reward(obs, jnp.array([1.0]), jnp.array([0.5, 0.1])), -0.26)


def test_logged_data_guide(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (code,) = python_blocks("docs/logged-data.md")
    exec(compile(code, "logged-data.md", "exec"), {})
    assert capsys.readouterr().out.count(",") == 3  # an error for each step of the horizon


def test_tutorial_notebook(tmp_path):
    notebook = nbformat.read(ROOT / "docs/tutorial.ipynb", 4)
    for cell in notebook.cells:  # the preset smoke has 20 steps
        cell.source = cell.source.replace('"quick"', '"smoke"').replace("{60:", "{10:")
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    shown = [
        out.data for cell in notebook.cells for out in cell.get("outputs", []) if "data" in out
    ]
    assert "Head selection" in shown[1]["text/html"]
    assert "image/gif" in shown[-1]


class Machine:
    """The machine that docs/controller.md serves: a cart whose sensor fails."""

    def __init__(self, readings):
        self.readings, self.sent, self.stopped = iter(readings), [], False

    def read(self):
        return next(self.readings)

    def send(self, action):
        self.sent.append(action)

    def stop(self):
        self.stopped = True

    def wait_for_next_period(self):
        pass


@pytest.mark.usefixtures("guide")
def test_controller_guide(capsys):
    service, *_ = python_blocks("docs/controller.md")
    service = service.replace("deadline_ms=80", "deadline_ms=6e4")
    names: dict = {}
    exec(compile(service, "controller.md", "exec"), names)

    seen = np.array([0.5, 0.0])
    machine = Machine([seen, None, None, seen, [1e6, 0.0], *4 * [None]])
    assert names["serve"](machine, 20).startswith("obs[0] is nan")  # a horizon of 4 holds for 3
    assert machine.stopped
    sent = np.stack(machine.sent)
    assert sent.shape == (8, 1)
    assert sent.dtype == np.float32
    assert (np.abs(sent) <= 3).all()
    told = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    held = [["1", "held"], ["2", "held"]]
    assert told == [*held, ["4", "planned"], *([str(step), "held"] for step in (5, 6, 7))]


class RosNode:
    """What the node of docs/controller.md needs of ROS 2."""

    def __init__(self, name):
        self.sent, self.said = [], []
        self.create_subscription = self.create_timer = lambda *args: None

    def create_publisher(self, *args):
        return types.SimpleNamespace(publish=lambda message: self.sent.append(message["data"]))

    def get_logger(self):
        return types.SimpleNamespace(error=self.said.append)


@pytest.mark.usefixtures("guide")
def test_ros_node(monkeypatch):
    spun = []
    parts = {
        "rclpy": {"init": lambda: None, "spin": spun.append},
        "rclpy.node": {"Node": RosNode},
        "sensor_msgs.msg": {"JointState": dict},
        "std_msgs.msg": {"Float64MultiArray": dict},
    }
    for name, part in parts.items():
        monkeypatch.setitem(sys.modules, name, types.SimpleNamespace(**part))
    (code,) = [block for block in python_blocks("docs/controller.md") if "rclpy" in block]
    code = code.replace("deadline_ms=80", "deadline_ms=6e4")
    exec(compile(code, "controller.md", "exec"), {})
    (node,) = spun
    node.see(types.SimpleNamespace(position=[0.5], velocity=[0.0]))
    for _ in range(5):  # it sees once, holds for three steps, and stops
        node.act()
    assert [len(sent) for sent in node.sent] == [1] * 5
    assert node.sent[4] == [0.0]
    assert len(node.said) == 1


def table_rows(path: str, heading: str) -> list[list[str]]:
    """The cells of the first table under a heading."""
    section = ("\n" + (ROOT / path).read_text()).partition(f"\n{heading}\n")[2]
    table = re.search(r"(?:^\|.*\n)+", section, re.MULTILINE)
    assert table is not None
    lines = table.group().splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize(("preset", "column"), [("paper", 2), ("quick", 4)])
def test_the_numbers_of_the_presets_are_those_of_the_page(preset, column):
    config = headway.make_config("half-cheetah", preset=preset)
    checked = 0
    for cells in table_rows("docs/reproduce.md", "## The paper's numbers"):
        told = {float(number) for number in re.findall(r"[\d.]+", cells[column] or cells[2])}
        for name in re.findall(r"`([a-z_.]+)`", cells[1]):
            values = np.atleast_1d(operator.attrgetter(name)(config))
            assert set(values.tolist()) <= told, f"{name} is {values} with {preset}"
            checked += 1
    assert checked > 20


def test_the_table_of_methods_has_every_method_once():
    cells = [row[0] for row in table_rows("docs/methods.md", "# Methods")]
    assert sorted(cell.strip("`") for cell in cells) == sorted(headway.METHODS)


PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "results").rglob("README.md")),
]


@pytest.mark.parametrize("command", COMMANDS)
def test_options_that_the_pages_show_exist(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help-all"])
    offered = {"--help-all", *re.findall(r"--[a-z][\w.-]*\w", capsys.readouterr().out)}
    for page in PAGES:
        text = re.sub(r"\\\n\s*", " ", page.read_text())
        for shown in re.findall(rf"headway {command} ([^`\n#]*)", text):
            unknown = set(re.findall(r"--[a-z][\w.-]*\w", shown)) - offered
            assert not unknown, f"{page.name} shows headway {command} with {unknown}"


def test_messages_that_are_explained_exist():
    source = "".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    said = re.sub(r'"\s*\n\s*f?"', "", source)  # texts over several lines
    explained = re.findall(r"^\| `(.+?)`", (ROOT / "docs/faq.md").read_text(), re.MULTILINE)
    assert len(explained) > 8
    for message in explained:
        for part in re.split(r"\d+|…", message):
            assert part.strip() in said, message


def test_settings_that_the_pages_name_exist():
    known = known_settings()
    for page in PAGES:
        named = re.findall(
            r"`((?:model|fitting|planner|collection|evaluation)\.(?!csv)[a-z_.]+)", page.read_text()
        )
        assert set(named) <= set(known), page.name


@pytest.fixture(scope="module")
def ridge(tmp_path_factory):
    """What the guide to own methods defines, its run small."""
    (code,) = python_blocks("docs/methods.md")
    names: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "METHODS", dict(methods.METHODS))
        patch.setattr(trainers, "TRAINERS", dict(trainers.TRAINERS))
        patch.setitem(MODELS, "ridge", OwnModelConfig)
        patch.chdir(tmp_path_factory.mktemp("methods"))
        exec(compile(code.replace('"quick"', '"smoke"'), "methods.md", "exec"), names)
        yield names


def test_own_method_guide(ridge):
    run = ridge["run"]
    assert run.config.method == "ridge"
    again = headway.evaluate(run.path, num_episodes=1)
    assert len(again) == 3
    controller = headway.load(run.path)
    controller.reset()
    assert controller.act(np.zeros(3)).shape == (1,)
    assert "ridge" in headway.write_report([run.path], run.path / "report.html").read_text()


@pytest.mark.usefixtures("ridge")
def test_an_own_model_is_fitted_resumed_and_planned_with(tmp_path):
    """On dynamics that are linear it is exact, and a run goes on where it was."""
    settings = {"collection.num_iterations": 1}
    first = headway.train(
        "pendulum", method="ridge", preset="smoke", run_dir=tmp_path / "a", settings=settings
    )
    weight = load_agent(RunDir(first.path)).model.parameters  # pyright: ignore
    parts = [(t.obs[:-1], t.action, t.obs[1:]) for t in RunDir(first.path).load_data()]
    obs, action, next_obs = map(np.concatenate, zip(*parts, strict=True))
    x = np.concatenate([obs, action, np.ones((len(obs), 1))], axis=1)
    expected = np.linalg.lstsq(x, next_obs - obs)[0]
    np.testing.assert_allclose(x @ weight, x @ expected, atol=1e-3)


@pytest.mark.usefixtures("ridge")
def test_what_cannot_be_registered():
    for name in ("tmcl", ""):
        with pytest.raises(ConfigError, match="is not free"):
            headway.register_method(headway.Method(name, "taken", {}))
    with pytest.raises(ConfigError, match=r"unknown setting 'model\.heads'"):
        headway.register_method(headway.Method("mine", "misspelt", {"model.heads": 3}))
    with pytest.raises(ConfigError, match="is not free"):
        headway.register_model("recurrent", headway.Trainer)
    with pytest.raises(ConfigError, match="no Trainer"):
        headway.register_model("mine", dict)
    with pytest.raises(ConfigError, match="kind is 'unheard'"):
        headway.make_config("pendulum", settings={"model.kind": "unheard"})
