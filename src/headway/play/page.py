"""The page of a player, with viser: the scene, what can be changed, what the controller sees."""

import contextlib
import io
import itertools
import math
import os
import socket
import sys
import time
import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from headway.config import OPTIMIZERS
from headway.errors import BadEnvironmentError, ConfigError, needs
from headway.play.player import REMEMBERED, Player
from headway.sim_params import Uniform
from headway.training.environments import raising
from headway.training.methods import KEEP_LEARNING
from headway.worlds.classic import CartPoleSwingUp
from headway.worlds.rendering import BODY, CART, GRID, HEADS, INK

SHIPPED = Path(__file__).parent / "pendulum"
"""A trained run that ships with Headway: `headway train pendulum --preset quick --seed 0
--model.hidden-sizes 64 64 64 --model.context-hidden-sizes 64 32`; smaller networks than `quick`
has, so that it is below 2 MB."""
FRAME_S, PLOT_S = 1 / 30, 1 / 5
"""Least time between two pictures of the scene, and of the plots."""
PUSHES = {"push −": -2.0, "push +": 2.0}
"""Changes of a velocity (m/s or rad/s)."""

Show = Callable[[Player], None]


def play(run_dir: str | Path | None = None, *, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a trained controller at work on a page in the browser, until Ctrl-C.

    The page opens by itself where there is a screen; its address is printed on stderr.

    Args:
        run_dir: The run directory; None takes a pendulum that ships with Headway.
        host: The address to listen at; others than loopback let others change the physics, too.
        port: The first port to try.

    Raises:
        RunError: There is no trained run, or it is damaged.
        ConfigError: viser is not installed, or this machine has no such address.
        BadEnvironmentError: The environment cannot be made.
    """
    needs("play", "viser", "mjviser")
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise ConfigError(
            f"host is {host!r} ({error.strerror}), allowed: an IPv4 address of this machine."
        ) from None
    player = Player(run_dir or SHIPPED)
    try:
        page = Page(player, host, port)
        print(f"Open {page.address} (Ctrl-C ends)", file=sys.stderr, flush=True)
        if sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
            webbrowser.open(page.address)
        player.run(page.show, page.server.get_clients)
    except KeyboardInterrupt:
        pass
    finally:
        player.environments.close()


class Page:
    """Shows a player and asks it for changes; `show` is called in the player's own thread.

    Args:
        player: What is shown.
        host: The address to listen at.
        port: The first port to try.
    """

    def __init__(self, player: Player, host: str, port: int):
        import viser

        self.player, config = player, player.config
        with contextlib.redirect_stdout(io.StringIO()):  # which is for results
            self.server: Any = viser.ViserServer(host=host, port=port, verbose=False)
        own = "127.0.0.1" if host == "0.0.0.0" else host
        self.address = f"http://{own}:{self.server.get_port()}"
        self._next = {"scene": 0.0, "plots": 0.0}
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_right()
        gui.set_panel_label(f"{config.env} · {config.method}")
        self.server.scene.set_up_direction("+z")
        self._status = gui.add_markdown("Compiling the plan …")
        with gui.add_folder("Physics"):
            for name, values in player.ranges.items():
                self._control(name, values)
            if hasattr(player.env, "set_state"):
                push = gui.add_button_group("disturb", tuple(PUSHES))
                push.on_click(lambda _: player.ask(partial(player.push, PUSHES[push.value])))
        acts = {"pause": self._pause, "step": self._step, "reset": player.reset}
        with gui.add_folder("Clock"):
            clock = gui.add_button_group("episode", tuple(acts))
            clock.on_click(lambda _: player.ask(acts[clock.value]))
            speed = gui.add_slider("speed", 0.25, 4.0, 0.25, player.speed)
            speed.on_update(lambda _: player.ask(partial(setattr, player, "speed", speed.value)))
        self._strip = gui.add_html(self._heads())
        known = player.spec.obs_names
        names = [*known, *(f"obs[{i}]" for i in range(len(known), len(player.obs)))]
        self._entry = gui.add_dropdown("observation", names[: len(player.obs)])
        self._entry.on_update(lambda _: player.ask(self._draw_plots))
        self._motion = self._plot("real", "predicted a step before, and planned")
        self._paid, self._taken = self._plot("reward"), self._plot("planning (ms)")
        self._learned = config.planner.adaptation != "none"  # in the run itself
        with gui.add_folder("Planner", expand_by_default=False):
            self._optimizer = gui.add_dropdown(
                "search", tuple(OPTIMIZERS), initial_value=config.planner.optimizer.name
            )
            self._learn = gui.add_checkbox("heads keep learning", self._learned)
            self._learn.visible = config.model.kind == "multi-headed"
            for control in (self._optimizer, self._learn):
                control.on_update(lambda _: player.ask(self._switch))
        self._scene = _scene(self.server, player)

    def _control(self, name: str, values: tuple[float, ...] | Uniform) -> None:
        """A slider for an amount, a choice for a kind."""
        gui, now = self.server.gui, self.player.sim_params[name]
        if isinstance(values, Uniform):
            step = 10.0 ** math.floor(math.log10((values.high - values.low) / 50))
            control = gui.add_slider(name, values.low, values.high, step, now)
        else:
            choices = tuple(f"{value:g}" for value in values)
            control = gui.add_dropdown(name, choices, initial_value=f"{now:g}")

        change = self.player.set_sim_params
        control.on_update(lambda _: self.player.ask(partial(change, {name: float(control.value)})))

    def _pause(self) -> None:
        self.player.paused = not self.player.paused

    def _step(self) -> None:
        self.player.paused = True
        self.player.step()

    def _switch(self) -> None:
        self._status.content = "Compiling the plan …"
        settings: dict[str, Any] = {"planner.optimizer.name": self._optimizer.value}
        if self._learn.value != self._learned:
            settings |= KEEP_LEARNING if self._learn.value else {"planner.adaptation": "none"}
        self.player.switch(settings)

    def _plot(self, *names: str) -> Any:
        """A plot of lines over the last steps, in seconds from now."""
        looks = zip(names, ({"stroke": "#8fa3b8", "width": 3}, {"stroke": "#d55e00"}), strict=False)
        series = ({"label": "s"}, *({"label": name} | look for name, look in looks))
        data = tuple(np.zeros(2) for _ in series)
        scales, height = {"x": {"time": False}}, 210 if len(names) > 1 else 130
        return self.server.gui.add_uplot(data, series, scales=scales, height=height)

    def show(self) -> None:
        """Show what is new; pictures and plots no more often than a browser can take."""
        now, player = time.monotonic(), self.player
        if now >= self._next["scene"] or player.paused:
            self._next["scene"] = now + FRAME_S
            self._scene(player)
        if now >= self._next["plots"] or player.paused:
            self._next["plots"] = now + PLOT_S
            self._draw_plots()

    def _draw_plots(self) -> None:
        player, moments = self.player, list(self.player.moments)
        self._status.content = self._words()
        if not moments:
            return
        self._strip.content = self._heads()
        entry, step = self._entry.options.index(self._entry.value), 1 / player.rate
        past = step * np.arange(1 - len(moments), 1)
        real = np.array([moment.obs[entry] for moment in moments])
        seen = [m.obs[entry] if m.imagined is None else m.imagined[0, entry] for m in moments]
        newest = moments[-1].imagined
        plan = np.zeros(0) if newest is None else newest[1:, entry]
        times = step * np.arange(1 - len(moments), len(plan) + 1)
        real = np.concatenate([real, np.full(len(plan), np.nan)])  # uPlot wants no NaN first
        self._motion.data = times, real, np.concatenate([seen, plan])
        self._paid.data = past, np.array([moment.reward for moment in moments])
        self._taken.data = past, np.array([1e3 * moment.seconds for moment in moments])

    def _words(self) -> str:
        player = self.player
        if not player.moments:
            words = "**paused**" if player.paused else "Compiling the plan …"
            return f"{words} {player.message}"
        newest, budget = player.moments[-1], 1e3 / (player.rate * player.speed)
        pace = "keeps up" if player.pace > 0.95 else f"**falls behind: {100 * player.pace:.0f} %**"
        words = f"planning {1e3 * newest.seconds:.1f} of {budget:.0f} ms, {pace}"
        words = "**paused**" if player.paused else words
        return f"{words} · reward {newest.reward:.2f}\n\n{player.message}"

    def _heads(self) -> str:
        """A strip per network, coloured by its chosen head; a line where physics changed."""
        moments, parts = list(self.player.moments), []
        first = REMEMBERED - len(moments)
        members = list(zip(*(m.heads for m in moments if m.heads is not None), strict=True))
        for row, heads in enumerate(members):
            at = first
            for head, same in itertools.groupby(heads):
                long, color = len(list(same)), HEADS[int(head) % len(HEADS)]
                parts.append(f'<rect x="{at}" y="{10 * row}" width="{long}" fill="{color}"/>')
                at += long
        for at, moment in enumerate(moments, first):
            if moment.changed:
                parts.append(f'<rect x="{at}" width="1" style="height: 100%"/>')
        rows = len(members)
        return (
            "<style>.heads rect { height: 7px }</style>"
            '<div style="padding: 0 0.6em"><small>head that each network plans with</small>'
            f'<svg class="heads" viewBox="0 0 {REMEMBERED} {10 * rows}" preserveAspectRatio="none"'
            f' shape-rendering="crispEdges" style="width: 100%; height: {16 * rows}px">'
            f"{''.join(parts)}</svg></div>"
        )


def _scene(server: Any, player: Player) -> Show:
    """What draws the environment: a robot or a classic world in 3D, others by their own frames."""
    classic = {"pendulum": _pendulum, "cartpole-swingup": _cart_pole}
    if player.spec.name in classic:
        return classic[player.spec.name](server)
    if hasattr(player.env, "models"):
        return _robot(server, player)

    def show(player: Player) -> None:
        try:
            with raising(player.spec.name, "a picture"):
                server.scene.set_background_image(player.environments.frame(), format="jpeg")
        except BadEnvironmentError as error:  # it cannot be drawn
            player.message = str(error)

    show(player)
    return show


def _flat(server: Any, distance: float) -> Any:
    """A scene seen from the front, with lights that a browser without a GPU can draw."""
    server.initial_camera.position = (0.0, -distance, 0.0)
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.add_light_ambient("/light", intensity=2.0)
    return server.scene


def _turned(angle: float) -> tuple[float, float, float, float]:
    """A rotation about the axis that points away from the viewer, as a quaternion."""
    return math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0


def _pendulum(server: Any) -> Show:
    scene, depth = _flat(server, 4.5), 0.12
    scene.add_box("/mount", color=INK, dimensions=(0.06, 0.3, 0.06))
    arm = scene.add_frame("/arm", show_axes=False)
    rod = scene.add_box("/arm/rod", color=BODY, dimensions=(depth, depth, 1.0))
    turn = np.linspace(0, 2 * np.pi, 65)
    circle = np.stack([np.sin(turn), 0 * turn, np.cos(turn)], 1)
    for length in (0.5, 1.0, 1.5):
        scene.add_spline_catmull_rom(f"/ring{length}", length * circle, segments=64, color=GRID)

    def show(player: Player) -> None:
        length = player.sim_params["length"]
        arm.wxyz = _turned(-float(player.env.states[0, 0]))
        rod.dimensions, rod.position = (depth, depth, length), (0.0, 0.0, length / 2)

    return show


def _cart_pole(server: Any) -> Show:
    scene, length = _flat(server, 5.0), CartPoleSwingUp.pole_length
    scene.add_box("/track", color=GRID, dimensions=(4.8, 0.05, 0.02))
    cart = scene.add_box("/cart", color=CART, dimensions=(0.4, 0.2, 0.2))
    pole = scene.add_frame("/pole", show_axes=False)
    rod = scene.add_box("/pole/rod", color=BODY, dimensions=(0.07, 0.07, length))

    def show(player: Player) -> None:
        x, _, angle, _ = map(float, player.env.states[0])
        bulk = float(np.clip(player.sim_params["mass_scale"], 0.05, 4.0)) ** (1 / 3)
        cart.position, cart.dimensions = (x, 0.0, 0.0), (0.4 * bulk, 0.2 * bulk, 0.2 * bulk)
        pole.position, pole.wxyz = (x, -0.15 * bulk, 0.0), _turned(angle)
        rod.dimensions, rod.position = (0.07 * bulk, 0.07 * bulk, length), (0.0, 0.0, length / 2)

    return show


def _robot(server: Any, player: Player) -> Show:
    import mujoco
    from mjviser import ViserMujocoScene

    (model,), (data,) = player.env.models, player.env.datas
    server.initial_camera.position = (0.0, -player.env.world.camera[0], 0.4)
    robot, looks = ViserMujocoScene(server, model, num_envs=1), model.geom_rgba.copy()

    def show(player: Player) -> None:
        nonlocal looks
        if not np.array_equal(looks, model.geom_rgba):  # a leg was crippled
            looks = model.geom_rgba.copy()
            robot.rebuild_visual_handles()
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        robot.update_from_mjdata(data)

    return show
