"""Memory: what a run will need, and what is free, compared before it starts."""

import itertools
from pathlib import Path
from typing import NamedTuple

import jax

from headway.config import Config
from headway.errors import LimitError
from headway.experiment.methods import told_sim_params
from headway.models.dynamics import context_layer, context_size
from headway.task import Task

PROCESS = 650 * 2**20  # Python, JAX, a simulator and compiled code, measured
WORKER = 120 * 2**20  # a process with an environment, its simulator included, measured
FLOAT = 4  # bytes
MEMINFO = Path("/proc/meminfo")
CGROUP = Path("/proc/self/cgroup")
CGROUP_ROOT = Path("/sys/fs/cgroup")
STATM = Path("/proc/self/statm")
PAGE = 4096
MAPS = Path("/proc/self/maps")
MAX_MAPS = Path("/proc/sys/vm/max_map_count")
TRY = (
    "choose smaller sizes, or give `headway train` --ignore-limits (ignore_limits=True) to try all"
    " the same."
)
FREE = "choose smaller sizes or fewer candidates, or end what else takes memory."


class MemoryNeed(NamedTuple):
    """Bytes that a run needs at its peak, within a factor of 2."""

    process: int
    """Before any array."""
    model: int
    """Weights and Adam's moments, with the copies that an update and a checkpoint make."""
    data: int
    """All episodes and the tables of their samples."""
    fitting: int
    """Shuffled samples of an epoch and the activations of a batch."""
    planning: int
    """Imagined rollouts of all candidates."""
    workers: int
    """The processes of the environments."""

    @property
    def total(self) -> int:
        """Fitting and planning are never at the same time."""
        own = self.process + self.model + self.data + max(self.fitting, self.planning)
        return own + self.workers

    def times(self, num_runs: int) -> "MemoryNeed":
        """What several runs need that go side by side in one process."""
        of_each = {n: num_runs * value for n, value in self._asdict().items() if n != "process"}
        return self._replace(**of_each)

    @property
    def to_load(self) -> "MemoryNeed":
        """What is needed when the model is only read."""
        return self._replace(process=0, data=0, fitting=0, planning=0, workers=0)

    @property
    def to_test(self) -> "MemoryNeed":
        """What is needed when nothing is fitted."""
        return self._replace(data=0, fitting=0)


def memory_need(config: Config, task: Task, episode_length: int) -> MemoryNeed:
    """Estimate a run's memory from its settings alone; nothing is allocated.

    Args:
        config: All settings.
        task: For the sizes of observations and actions.
        episode_length: Steps of an episode.
    """
    collection = config.collection
    steps = collection.num_iterations * collection.num_episodes * episode_length
    samples = steps * config.fitting.future_length
    members = config.model.num_members
    step = task.obs_size + task.action_size
    # As they were read, laid out in NumPy and once more on the device.
    episodes = steps * (3 * step * FLOAT + 8)
    # Number of the episode, anchor and offset: in rows, as a table, padded, on the device.
    table = samples * 4 * 3 * FLOAT
    rows = members * samples * FLOAT
    workers = collection.num_episodes if collection.env_processes else 0
    return MemoryNeed(
        PROCESS,
        16 * FLOAT * num_parameters(config, task),
        episodes + table + rows,
        6 * rows + _batch(config, task, episode_length) + _assignment(config, task, episode_length),
        _planning(config, task),
        workers * WORKER,
    )


def num_parameters(config: Config, task: Task) -> int:
    """Weights of the whole ensemble, to a few percent."""
    model = config.model
    features = 2 * task.obs_size + task.action_size
    if model.kind == "recurrent":
        pairs = itertools.pairwise((features, *model.hidden_sizes))
        gates = sum(4 * (n + m + 1) * m for n, m in pairs)
        return gates + _dense((model.hidden_sizes[-1], task.obs_size))
    hidden = _dense((features, *model.hidden_sizes))
    context, place = _context_size(config, task), context_layer(model)
    outputs = (model.hidden_sizes[-1] + 1 + (context if place is None else 0)) * task.obs_size
    if place is not None:
        hidden += context * model.hidden_sizes[place]
    heads = model.num_heads * outputs * (1 if model.deterministic else 2)
    nets = (2 if model.backward_net else 1) * (hidden + heads)
    if model.context == "learned" and context:
        history = model.history_length * (task.obs_size + task.action_size)
        nets += _dense((history, *model.context_hidden_sizes, context))
    return model.num_members * nets


def _context_size(config: Config, task: Task) -> int:
    return context_size(config.model, task, len(told_sim_params(config)))


def _dense(sizes: tuple[int, ...]) -> int:
    return sum((n + 1) * m for n, m in itertools.pairwise(sizes))


def _batch(config: Config, task: Task, episode_length: int) -> int:
    """Activations of one update, kept for the gradient; a recurrent network's in every step.

    In training for adaptation an update also looks at an episode.
    """
    model = config.model
    if model.kind == "recurrent":
        return FLOAT * config.fitting.batch_size * 12 * sum(model.hidden_sizes)
    heads = 2 * model.num_heads * (model.hidden_sizes[-1] + 3 * task.obs_size)
    widths = 3 * (sum(model.hidden_sizes) + sum(model.context_hidden_sizes)) + heads
    nets = 2 if model.backward_net else 1
    rows = config.fitting.batch_size
    of_batch = nets * model.num_members * rows * widths
    return FLOAT * (of_batch + _relation(config, task))


def _relation(config: Config, task: Task) -> int:
    """Numbers about all pairs of a batch's contexts, for the gradient of one state."""
    samples, states = config.fitting.batch_size, config.fitting.relation_transitions
    if not config.model.relation_head:
        return 0
    pairs = samples**2 * (2 * task.obs_size + min(states or samples, samples) + 10)
    return config.model.num_members * pairs


def _assignment(config: Config, task: Task, episode_length: int) -> int:
    """Losses of every head on one episode."""
    model = config.model
    widths = 3 * max(model.hidden_sizes) + 6 * model.num_heads * task.obs_size
    return FLOAT * model.num_members * episode_length * widths


def _planning(config: Config, task: Task) -> int:
    """One imagined step of every particle, and the candidates."""
    planner, envs = config.planner, config.collection.num_episodes
    particles = envs * planner.num_candidates * planner.num_particles
    widest = 2 * max(config.model.hidden_sizes) + 8 * task.obs_size + 4 * task.action_size
    candidates = envs * planner.num_candidates * planner.horizon * task.action_size
    return FLOAT * (particles * widest + 4 * candidates)


def check_memory(need: MemoryNeed, *, may_ignore: bool = False) -> None:
    """Refuse what does not fit, before the system's killer does.

    Args:
        need: What it takes.
        may_ignore: Whether this is training, which can be told to ignore the limits.

    Raises:
        LimitError: The estimate is above what is free on the machine or on its accelerator.
    """
    device, advice = jax.local_devices()[0], TRY if may_ignore else FREE
    on_host = need
    if device.platform != "cpu":
        on_host = need._replace(model=0, fitting=0, planning=0)
        stats = device.memory_stats() or {}
        limit, used = stats.get("bytes_limit"), stats.get("bytes_in_use", 0)
        on_device = need._replace(process=0, workers=0)
        _compare(on_device, limit and limit - used, f"on {device.device_kind}; {advice}")
    free = free_memory()
    _compare(on_host, free if free is None else free + resident(), f"on this machine; {advice}")


def _compare(need: MemoryNeed, free: int | None, where_and_advice: str) -> None:
    if free is None or need.total <= free:
        return
    parts = ", ".join(f"{name} {gib(value)}" for name, value in need._asdict().items() if value)
    raise LimitError(
        f"this run needs about {gib(need.total)} GiB of memory ({parts}), {gib(free)} GiB is free"
        f" {where_and_advice}"
    )


def gib(num_bytes: int) -> str:
    """Word a size."""
    return f"{num_bytes / 2**30:.3g}" if num_bytes < 2**70 else "over 10^12"


def resident() -> int:
    """Bytes that this process holds already."""
    try:
        return int(STATM.read_text().split()[1]) * PAGE
    except (OSError, ValueError, IndexError):
        return 0


def make_room_for_programs() -> bool:
    """Forget all compiled programs if this process is half-way to its limit of memory maps.

    JAX keeps what it compiled for ever, which is about a thousand maps for a run, and crashes
    beyond what Linux allows (65,530 by default). What is needed again is compiled again, or read
    from the persistent cache; a controller in the same process then answers late once.

    Returns:
        Whether they were forgotten.
    """
    try:
        allowed = int(MAX_MAPS.read_text())
        with MAPS.open("rb") as lines:
            used = sum(1 for _ in lines)
    except (OSError, ValueError):  # no Linux
        return False
    if 2 * used < allowed:
        return False
    jax.clear_caches()
    return True


def free_memory() -> int | None:
    """Bytes that can still be had, by the machine and by the control group; None if unknown."""
    found = [value for value in (_available(), *_cgroup_free()) if value is not None]
    return min(found, default=None)


def _available() -> int | None:
    try:
        lines = MEMINFO.read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        name, _, value = line.partition(":")
        if name == "MemAvailable":
            return int(value.split()[0]) * 1024
    return None


def _cgroup_free() -> list[int | None]:
    """What each control group above this process still allows (versions 2 and 1)."""
    try:
        lines = CGROUP.read_text().splitlines()
    except OSError:
        return []
    found: list[int | None] = []
    for line in lines:
        _, controllers, place = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        root = CGROUP_ROOT / controllers
        names = ("memory.max", "memory.current")
        if controllers:
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
        folder = root / place.strip("/")
        found += [
            _left(parent, *names)
            for parent in (folder, *folder.parents)
            if root in (parent, *parent.parents)
        ]
    return found


def _left(folder: Path, limit_name: str, used_name: str) -> int | None:
    try:
        limit, used = (int((folder / name).read_text()) for name in (limit_name, used_name))
    except (OSError, ValueError):  # no such group, or a limit that is called "max"
        return None
    return max(limit - used, 0) + _file_cache(folder)


def _file_cache(folder: Path) -> int:
    """Counted as used, but given back when it is needed."""
    try:
        lines = (folder / "memory.stat").read_text().splitlines()
    except OSError:
        return 0
    stats = dict(line.split(" ", 1) for line in lines if " " in line)
    names = ("inactive_file", "total_inactive_file")
    return max(int(stats.get(name, 0)) for name in names)
