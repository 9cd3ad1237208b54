"""One test episode over time."""

from types import SimpleNamespace

import jax
import numpy as np
from matplotlib.figure import Figure

from headway.lab import episode
from headway.lab.figures import save_run_figures
from headway.models.base import FunctionModel
from headway.training import selection
from headway.training.diagnostics import imagine_from
from headway.training.run import RunDir
from headway.training.trainers import load_agent


def test_lines_stand_at_the_moment_that_they_predict(reference, monkeypatch):
    """A model that adds one to each number is off by as much as it looks ahead."""
    agent = SimpleNamespace(model=FunctionModel((), lambda _, obs, action: obs + 1.0))
    monkeypatch.setattr(episode, "load_agent", lambda run, config: agent)
    about, panels = episode.follow_episode(reference)
    tests = [t for found in RunDir(reference).tests().values() for t in found]
    median = sorted(tests, key=lambda test: test.returns)[len(tests) // 2]
    assert f"median return, {median.returns:,.1f}:" in about
    assert [*panels] == ["cos θ", "sin θ", "angular velocity (rad/s)", "actions, scaled to ±1"]
    axes = Figure().subplots()
    panels["sin θ"](axes)
    for ahead, line in zip((0, 1, episode.AHEAD), axes.get_lines(), strict=True):
        moments = np.asarray(line.get_xdata(), int)
        assert moments[0] == ahead
        np.testing.assert_allclose(line.get_ydata(), median.obs[moments - ahead, 1] + ahead, 1e-5)


def test_the_heads_are_those_that_the_agent_had(root):
    assert save_run_figures(root)[-1].name == "episode.png"
    run, key = RunDir(root), jax.random.key(0)
    model, (real, *_) = load_agent(run).model, run.tests()["high"]
    starts = [(real, start) for start in range(len(real) - 1)]
    heads = np.asarray(imagine_from(model, starts, 2, key)[1])
    (examined,) = selection.examine(model, [real], key=key)
    assert np.ptp(heads) > 0
    np.testing.assert_array_equal(heads[1:], examined.chosen[: len(heads) - 1])
